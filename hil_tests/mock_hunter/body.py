"""The body: actuators with a lag and a rate, and the way that the wheels cover. Pure.

Angles are positive to the left. The inner front wheel is the one on the side of the turn.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hil_tests.mock_hunter.parameters import Parameters

STANDS_MPS = 0.005
"""Slower than this it stands: half of what one count in 0x221 could show is 0.0005."""


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
