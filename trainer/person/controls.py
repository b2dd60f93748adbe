"""What a person's keys, sticks and pedals do in an environment: its own ``keys``, or the arrows.

A device says which of the environment's keys are pressed, and how far: a steering wheel presses
left or right, pedals press up and down.
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache

import numpy as np

from edge_runtime.util import UserError
from trainer.environments import Adapted, make_environment
from trainer.person.interface import Amount, amount, vector

RESERVED = {"p", "r", "q", "escape", "backspace", "space"}  # Of the wishes and of Space


@dataclass(frozen=True)
class Controls:
    """The keys of one environment."""

    keys: Mapping[str, Amount]
    """Key, in small letters as ``up`` or ``w`` -> what pressing it fully adds to ``rest``."""
    rest: Amount  # Hands off
    rate_per_s: float  # How quickly a key presses
    names: tuple[str, ...]  # Of the actions

    def mix(self, shares: Mapping[str, float]) -> Amount:
        """Return the action for keys pressed by these shares, 0 to 1; unknown keys do nothing."""
        pressed = [np.multiply(share, self.keys[key]) for key, share in shares.items()
                   if key in self.keys]  # fmt: skip
        return amount(np.clip(np.add(self.rest, sum(pressed)), -1.0, 1.0))

    @property
    def help(self) -> str:
        """A line for the page: which key does what."""
        held: dict[Amount, list[str]] = {}
        for key in self.keys:
            held.setdefault(self.mix({key: 1.0}), []).append(key.capitalize())
        what = (f"{' / '.join(keys)}: {_text(self.names, act)}" for act, keys in held.items())
        return "    ".join(["hold to take over", *what, "Space: hands off"])


def _text(names: tuple[str, ...], action: Amount) -> str:
    return ", ".join(f"{n} {v:+g}" for n, v in zip(names, vector(action), strict=True))


@cache
def controls_of(scenario: str) -> Controls:
    """Return the controls of an environment; UserError where a person cannot drive it."""
    with closing(make_environment(scenario)) as env:
        if isinstance(env, Adapted) and not env.can_be_seen:
            what = "it offers no render() and no scene()"
            raise UserError(f"a person cannot see {scenario}: {what}")
        if not env.keys:
            what = "it has several actions, and no keys"
            raise UserError(f"a person cannot drive {scenario}: {what}")
        rest = amount(env.rest_action)
        keys = {
            name.lower().removeprefix("arrow").removeprefix("key"): amount(np.subtract(held, rest))
            for name, held in env.keys.items()
        }
        controls = Controls(keys, rest, env.key_rate_per_s, tuple(env.action_names))
    if taken := sorted(RESERVED & keys.keys()):
        what = "pause, restart, discard, quit or hold without driving"
        raise UserError(f"{scenario} is driven with {', '.join(taken)}, which {what}: name others")
    return controls
