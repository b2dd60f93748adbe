"""What a mock Hunter is made of: parameters, actuators with a lag and a rate, battery. Pure.

Angles are positive to the left. The inner front wheel is the one on the side of the turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from edge_runtime.util import UserError

ASSUMED = "assumed"
_MANUAL = "AgileX user manual (HARDWARE_FACTS.md)"
STANDS_MPS = 0.005
"""Slower than this it stands: half of what one count in 0x221 could show is 0.0005."""
_NEARLY_EMPTY = 0.05


@dataclass(frozen=True)
class Parameters:
    """Geometry, actuators and battery of one model; SOURCES says how far to trust each number."""

    max_speed_mps: float
    max_inner_rad: float
    """Of the inner front wheel."""
    wheelbase_m: float
    track_m: float
    command_timeout_s: float = 0.5
    dead_time_s: float = 0.03
    """From a command on the bus to the first movement of an actuator."""
    speed_time_constant_s: float = 0.1
    acceleration_mps2: float = 2.0
    braking_mps2: float = 3.0
    """Of the speed controller, and of the brake: the chassis stops a moving car with either."""
    steering_rate_radps: float = 1.0
    """Of the inner wheel."""
    motor_revolutions_per_m: float = 20.0
    """Of path of a rear wheel."""
    steer_revolutions_per_rad: float = 20.0
    """Of the steering motor, for each radian of the inner wheel."""
    pulses_per_revolution: float = 100.0
    """Of a motor's encoder."""
    full_v: float = 28.0
    empty_v: float = 21.0
    undervoltage_v: float = 22.0
    capacity_as: float = 30 * 3600.0
    resistance_ohm: float = 0.02
    idle_a: float = 2.0
    drive_a_per_mps: float = 4.0
    drive_a_per_mps2: float = 10.0


MODELS: dict[str, Parameters] = {
    "hunter-2.0": Parameters(
        max_speed_mps=1.5, max_inner_rad=0.576, wheelbase_m=0.650, track_m=0.605
    ),
    # The SE's manual leaves its track between 0.46 and 0.52 m: the middle is assumed.
    "hunter-se": Parameters(
        max_speed_mps=4.8, max_inner_rad=0.400, wheelbase_m=0.55, track_m=0.49,
        acceleration_mps2=3.0, braking_mps2=4.0,
    ),
}  # fmt: skip

_FROM_THE_MANUAL = (
    "max_speed_mps", "max_inner_rad", "wheelbase_m", "track_m", "command_timeout_s",
)  # fmt: skip
SOURCES: dict[str, str] = {
    field.name: _MANUAL if field.name in _FROM_THE_MANUAL else ASSUMED
    for field in fields(Parameters)
}
"""The manual says nothing of how fast the actuators are: measure them on the vehicle, and pass
them with ``--set``."""


def make_parameters(model: str, changes: Mapping[str, float] | None = None) -> Parameters:
    """A model's row with some numbers replaced.

    Raises:
        UserError: an unknown name, or a number that is not positive (a dead time may be 0).
    """
    for name, value in (changes or {}).items():
        if name not in SOURCES:
            raise UserError(f"no parameter {name!r}; choose from {', '.join(SOURCES)}")
        if not (value > 0.0 or (name == "dead_time_s" and value == 0.0)) or value == float("inf"):
            raise UserError(f"parameter {name} must be above 0, not {value}")
    return replace(MODELS[model], **(changes or {}))


def read_changes(texts: list[str]) -> dict[str, float]:
    """Read the values of `--set NAME=VALUE`; UserError for one that is none."""
    changes = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            changes[name] = float(value)
        except ValueError:
            raise UserError(f"--set {text!r} is not valid: use NAME=VALUE") from None
    return changes


class Setpoint(NamedTuple):
    """What is asked of the body: speed, and the angle of the inner front wheel."""

    speed_mps: float = 0.0
    inner_rad: float = 0.0


class Body(NamedTuple):
    """Its speed, its inner wheel's angle and the rate of that, and the way of each rear wheel."""

    speed_mps: float = 0.0
    inner_rad: float = 0.0
    steering_radps: float = 0.0
    right_m: float = 0.0
    left_m: float = 0.0

    @property
    def stands(self) -> bool:
        """Whether it does not move."""
        return abs(self.speed_mps) < STANDS_MPS


def advance(body: Body, setpoint: Setpoint | None, step_s: float, parameters: Parameters) -> Body:
    """One integration step towards the set-point; None: the brake, with the steering held."""
    if setpoint is None:
        speed_mps = _towards(body.speed_mps, 0.0, parameters.braking_mps2 * step_s)
        inner_rad = body.inner_rad
    else:
        speed_mps = _follow_speed(body.speed_mps, setpoint.speed_mps, step_s, parameters)
        wanted_rad = _limit(setpoint.inner_rad, parameters.max_inner_rad)
        inner_rad = _towards(body.inner_rad, wanted_rad, parameters.steering_rate_radps * step_s)
    steering_radps = (inner_rad - body.inner_rad) / step_s
    after = body._replace(speed_mps=speed_mps, inner_rad=inner_rad, steering_radps=steering_radps)
    return roll(after, step_s, parameters)


def roll(body: Body, step_s: float, parameters: Parameters) -> Body:
    """The way of the rear wheels at the present speed; in a turn the outer one covers more."""
    half = curvature(body.inner_rad, parameters) * parameters.track_m / 2
    way_m = body.speed_mps * step_s
    return body._replace(
        right_m=body.right_m + way_m * (1 + half), left_m=body.left_m + way_m * (1 - half)
    )


def curvature(inner_rad: float, parameters: Parameters) -> float:
    """Of the rear axle's middle, 1/m: the inner wheel's radius is half a track shorter (Ackermann).

    radius = wheelbase / tan(inner) + track / 2
    """
    slope = math.tan(abs(inner_rad))
    amount = slope / (parameters.wheelbase_m + slope * parameters.track_m / 2)
    return math.copysign(amount, inner_rad)


def _follow_speed(speed_mps: float, wanted: float, step_s: float, parameters: Parameters) -> float:
    wanted = _limit(wanted, parameters.max_speed_mps)
    change = (wanted - speed_mps) * (1 - math.exp(-step_s / parameters.speed_time_constant_s))
    slower = speed_mps * change < 0
    rate = parameters.braking_mps2 if slower else parameters.acceleration_mps2
    return speed_mps + _limit(change, rate * step_s)


def _towards(value: float, target: float, most: float) -> float:
    return value + _limit(target - value, most)


def _limit(value: float, most: float) -> float:
    return min(max(value, -most), most)


class Battery:
    """A voltage that falls with the charge, and sags under current."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._fraction = 1.0
        self.amperes = parameters.idle_a
        """Drawn from it now."""
        self._before_empty: float | None = None

    @property
    def volts(self) -> float:
        """At its terminals, now."""
        p = self._parameters
        open_v = p.empty_v + (p.full_v - p.empty_v) * self._fraction
        return open_v - p.resistance_ohm * self.amperes

    @property
    def too_low(self) -> bool:
        """Whether the chassis calls it undervoltage."""
        return self.volts < self._parameters.undervoltage_v

    def advance(self, speed_mps: float, acceleration_mps2: float, step_s: float) -> None:
        """Draw what this motion takes; braking gives nothing back."""
        p = self._parameters
        drive_a = p.drive_a_per_mps * abs(speed_mps)
        self.amperes = p.idle_a + drive_a + p.drive_a_per_mps2 * max(0.0, acceleration_mps2)
        used = self.amperes * step_s / p.capacity_as
        self._fraction = max(0.0, self._fraction - used)

    def empty(self, on: bool) -> None:
        """Be nearly empty, or as full as before."""
        if on and self._before_empty is None:
            self._before_empty, self._fraction = self._fraction, _NEARLY_EMPTY
        elif not on and self._before_empty is not None:
            self._fraction, self._before_empty = self._before_empty, None
