"""What the axes and buttons of a wheel or a gamepad mean: a TOML file, checked when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from edge_runtime.util import UserError, read_toml
from trainer.person.interface import Moving

SHIPPED = Path(__file__).parent / "profiles"
Number = Annotated[int, msgspec.Meta(ge=0, le=63)]
Place = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
"""Where an axis is; SDL's go from -1 to 1."""
SHORTEST = 0.02
"""The least way of a wheel or pedal: its noise must not be a full action."""
DeadZone = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]


class Steering(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests in its middle."""

    axis: Number
    left: Place = -1.0
    """Where the action is -1. Short of the axis' end where a hand should not turn that far; the
    larger of the two where the axis runs the other way round."""
    centre: Place = 0.0
    right: Place = 1.0
    dead_zone: DeadZone = 0.02
    """Share of the way from the centre in which nothing happens."""

    def __post_init__(self) -> None:
        if not (self.left < self.centre < self.right or self.left > self.centre > self.right):
            raise ValueError("centre is not between left and right")
        if min(abs(self.left - self.centre), abs(self.right - self.centre)) < SHORTEST:
            raise ValueError(f"left and right are not {SHORTEST} from centre")

    def action(self, place: float) -> float:
        """The steering in [-1, 1] for the axis' place; no jump at the dead zone's edge."""
        side = self.right if (place - self.centre) * (self.right - self.centre) > 0 else self.left
        share = _beyond((place - self.centre) / (side - self.centre), self.dead_zone)
        return share if side == self.right else -share


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
        way = (place - self.released) / (self.pressed - self.released)
        return _beyond(way, self.dead_zone)


class Buttons(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Button numbers; any of a list will do."""

    hold: tuple[Number, ...] = ()
    pause: tuple[Number, ...] = ()
    restart: tuple[Number, ...] = ()
    discard: tuple[Number, ...] = ()
    quit: tuple[Number, ...] = ()


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
    buttons: Buttons = Buttons()

    def __post_init__(self) -> None:
        if self.rest >= self.threshold:
            raise ValueError("rest must be below threshold")
        if self.take_over == "holding" and not self.buttons.hold:
            raise ValueError("take_over is by holding, but buttons.hold is empty")

    @property
    def moving(self) -> Moving:
        """What counts as moving."""
        return Moving(self.threshold, self.rest, self.rest_s)

    def action(self, scenario: str, places: dict[int, float]) -> float:
        """The scenario's action from the axes' places; an axis not in ``places`` is at rest."""
        if scenario == "congestion":
            return self._of(self.steering, places, self.steering.centre)
        throttle = self._of(self.throttle, places, self.throttle.released)
        return throttle - self._of(self.brake, places, self.brake.released)

    @staticmethod
    def _of(axis: Steering | Pedal, places: dict[int, float], at_rest: float) -> float:
        return axis.action(places.get(axis.axis, at_rest))


def read_profile(path: Path) -> Profile:
    """Read a profile.

    Raises:
        UserError: no such file, no TOML, or no profile; one line says where.
    """
    values = read_toml(path, "profile")
    try:
        return msgspec.convert(values, Profile)
    except msgspec.ValidationError as error:
        raise UserError(f"profile {path}: {error}") from None


def _beyond(share: float, dead_zone: float) -> float:
    """The share of the way beyond the dead zone, in [0, 1]."""
    return min(max((share - dead_zone) / (1.0 - dead_zone), 0.0), 1.0)
