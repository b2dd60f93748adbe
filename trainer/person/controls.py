"""What a person's keys, sticks and pedals do in an environment: its own ``keys``, or the arrows.

A device says which of the environment's keys are pressed, and how far: a steering wheel presses
left or right, pedals press up and down. An action is one number, or a tuple of them where the
environment has several.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from edge_runtime.util import UserError
from trainer.environments import Adapted, make_environment

RESERVED = {"p", "r", "q", "escape", "backspace", "space"}  # Of the wishes and of Space
Amount = float | tuple[float, ...]  # An action in [-1, 1]: one number where there is one


def amount(action: Any) -> Amount:
    """An action of any kind as one."""
    values = np.asarray(action, float).reshape(-1).tolist()
    return values[0] if len(values) == 1 else tuple(values)


def distance(one: Amount, other: Amount) -> float:
    """How far two actions are apart, in the number that differs most."""
    return float(np.abs(np.subtract(one, other)).max())


def vector(action: Amount) -> Any:
    """An action as the environment takes it, float32 [n]."""
    return np.atleast_1d(np.asarray(action, np.float32))


@dataclass(frozen=True)
class Controls:
    """The keys of one environment."""

    keys: Mapping[str, Amount]
    """Key, in small letters as ``up`` or ``w`` -> what pressing it fully adds to ``rest``."""
    rest: Amount  # Hands off
    rate_per_s: float  # How quickly a key presses
    names: tuple[str, ...]  # Of the actions

    def mix(self, shares: Mapping[str, float]) -> Amount:
        """The action while keys are pressed so far, each from 0 to 1; unknown ones do nothing."""
        pressed = [np.multiply(share, self.keys[key]) for key, share in shares.items()
                   if key in self.keys]  # fmt: skip
        return amount(np.clip(np.add(self.rest, sum(pressed)), -1.0, 1.0))

    @property
    def help(self) -> str:
        """What to hold for what, in one line."""
        held: dict[Amount, list[str]] = {}
        for key in self.keys:
            held.setdefault(self.mix({key: 1.0}), []).append(key.capitalize())
        what = (f"{' / '.join(keys)}: {_text(self.names, act)}" for act, keys in held.items())
        return "    ".join(["hold to take over", *what, "Space: hands off"])


def _text(names: tuple[str, ...], action: Amount) -> str:
    return ", ".join(f"{n} {v:+g}" for n, v in zip(names, vector(action), strict=True))


@cache
def controls_of(scenario: str) -> Controls:
    """The controls of an environment, by its name; UserError where a person could not drive it."""
    env = make_environment(scenario)
    if isinstance(env, Adapted) and not env.can_be_seen:
        raise UserError(f"a person cannot see {scenario}: it offers no render() and no scene()")
    rest = amount(env.rest_action)
    keys = {
        name.lower().removeprefix("arrow").removeprefix("key"): amount(np.subtract(action, rest))
        for name, action in env.keys.items()
    }
    return Controls(keys, rest, env.key_rate_per_s, tuple(env.action_names))


def keyboard_of(scenario: str) -> Controls:
    """The same for a device with keys; UserError where they have another use."""
    controls = controls_of(scenario)
    if taken := sorted(RESERVED & controls.keys.keys()):
        what = "pause, restart, discard, quit or hold without driving"
        raise UserError(f"{scenario} is driven with {', '.join(taken)}, which {what}: name others")
    return controls
