"""What a person's keys, sticks and pedals do in an environment: its own ``keys``, or the arrows.

A device says which of the environment's keys are pressed, and how far: a steering wheel presses
left or right, pedals press up and down. What the axes and buttons of a wheel or gamepad mean, a
profile says: a TOML file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from edge_runtime.util import UserError, read_toml
from trainer.environments import Adapted, make_environment
from trainer.person.interface import Amount, Moving, Wish, amount, vector

SHIPPED = Path(__file__).parent / "profiles"
Number = Annotated[int, msgspec.Meta(ge=0, le=63)]
Place = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]  # Of an axis, as SDL gives it
SHORTEST = 0.02  # The shortest travel of a wheel or pedal: its noise must not be a full action
DeadZone = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
RESERVED = {"p", "r", "q", "escape", "backspace", "space"}  # Of the wishes and of Space


@dataclass(frozen=True)
class Controls:
    """The keys of one environment."""

    keys: Mapping[str, Amount]
    """Key, in small letters as ``up`` or ``w`` -> what pressing it fully adds to ``rest``."""
    rest: Amount  # Hands off
    rate_per_s: float  # How quickly a key presses
    period_s: float  # From one action to the next
    names: tuple[str, ...]  # Of the actions

    def mix(self, shares: Mapping[str, float]) -> Amount:
        """The action for keys pressed by these shares, 0 to 1; unknown ones do nothing."""
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
    if not env.keys:
        raise UserError(f"a person cannot drive {scenario}: it has several actions, and no keys")
    rest = amount(env.rest_action)
    keys = {
        name.lower().removeprefix("arrow").removeprefix("key"): amount(np.subtract(action, rest))
        for name, action in env.keys.items()
    }
    rates = env.key_rate_per_s, env.control_period_s
    return Controls(keys, rest, *rates, tuple(env.action_names))


def keyboard_of(scenario: str) -> Controls:
    """The same for a device with keys; UserError where they have another use."""
    controls = controls_of(scenario)
    if taken := sorted(RESERVED & controls.keys.keys()):
        what = "pause, restart, discard, quit or hold without driving"
        raise UserError(f"{scenario} is driven with {', '.join(taken)}, which {what}: name others")
    return controls


class Steering(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests in its middle."""

    axis: Number
    left: Place = -1.0
    """Where the action is -1: before the axis' end, where a hand should not turn that far. It is
    larger than ``right`` where the axis is reversed."""
    centre: Place = 0.0
    right: Place = 1.0
    dead_zone: DeadZone = 0.02  # The share of the way from the centre in which nothing happens

    def __post_init__(self) -> None:
        if not (self.left < self.centre < self.right or self.left > self.centre > self.right):
            raise ValueError("centre is not between left and right")
        if min(abs(self.left - self.centre), abs(self.right - self.centre)) < SHORTEST:
            raise ValueError(f"left and right are not {SHORTEST} from centre")

    def action(self, place: float) -> float:
        """The steering in [-1, 1] for the axis' place; no jump at the dead zone's edge."""
        right, left = (
            _share(place, self.centre, side, self.dead_zone) for side in (self.right, self.left)
        )
        return right - left


class Pedal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests at one end."""

    axis: Number
    released: Place = -1.0
    pressed: Place = 1.0
    dead_zone: DeadZone = 0.05

    def __post_init__(self) -> None:
        if abs(self.released - self.pressed) < SHORTEST:
            raise ValueError(f"released and pressed are not {SHORTEST} apart")

    def action(self, place: float) -> float:
        """How far it is pressed, in [0, 1]."""
        return _share(place, self.released, self.pressed, self.dead_zone)


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One model of wheel or gamepad."""

    name: str
    steering: Steering
    throttle: Pedal
    brake: Pedal
    match: str = ""
    """What the device's name, as SDL gives it, contains; empty: whatever is plugged in."""
    take_over: Literal["holding", "moving"] = "holding"
    """By a button of ``buttons.hold`` alone, or by moving the wheel or a pedal, too."""
    threshold: Share = Moving.threshold
    rest: Share = Moving.rest
    rest_s: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = Moving.rest_s
    buttons: dict[Literal["hold"] | Wish, tuple[Number, ...]] = {}
    """Button numbers; any of a list will do."""

    def __post_init__(self) -> None:
        if self.rest >= self.threshold:
            raise ValueError("rest must be below threshold")
        if self.take_over == "holding" and not self.buttons.get("hold"):
            raise ValueError("take_over is by holding, but buttons.hold is empty")

    def action(self, scenario: str, places: dict[int, float]) -> Amount:
        """The scenario's action from the axes' places; an axis not in ``places`` is at rest.

        The wheel presses the environment's key left or right, the pedals press up and down.
        """
        turned = self.steering.action(places.get(self.steering.axis, self.steering.centre))
        up, down = (
            pedal.action(places.get(pedal.axis, pedal.released))
            for pedal in (self.throttle, self.brake)
        )
        shares = {"left": max(-turned, 0.0), "right": max(turned, 0.0), "up": up, "down": down}
        return controls_of(scenario).mix(shares)


def read_profile(path: Path) -> Profile:
    """Read a profile; UserError where there is none, or it is wrong: one line says where."""
    values = read_toml(path, "profile")
    try:
        return msgspec.convert(values, Profile)
    except msgspec.ValidationError as error:
        raise UserError(f"profile {path}: {error}") from None


def _share(place: float, start: float, end: float, dead_zone: float) -> float:
    """The share of the way from start to end, beyond the dead zone, in [0, 1]."""
    way = (place - start) / (end - start)
    return min(max((way - dead_zone) / (1.0 - dead_zone), 0.0), 1.0)
