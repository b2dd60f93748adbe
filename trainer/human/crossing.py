"""Will the ego car and the traffic meet? The foresight behind the expert and the trigger.

The ego car moves along its planned path under a given pedal, traffic goes on at its present
speed. Both are followed for a few seconds; they meet when, at the same instant, a car's length
and the stretch of its lane that the ego car covers overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.geometry import Rectangle, corners
from trainer.scenarios.left_turn import LeftTurnEnv

TABLE_STEP_M = 0.1


@dataclass(frozen=True)
class PedalPlan:
    """What the ego car is supposed to do: a pedal for a while, then a speed."""

    pedal: float = 1.0
    hold_s: float = 0.0
    then_mps: float | None = None
    """Full throttle up to this speed; None keeps the speed that the pedal led to."""
    then_brake: float = 0.0
    """Instead of that: this share of the full brake, until the car stands."""


class Crossing:
    """Foresight for one left-turn environment.

    Args:
        env: the environment looked at.
        side_clearance_m: room kept to the sides of a passing car.
    """

    def __init__(self, env: LeftTurnEnv, side_clearance_m: float) -> None:
        self.env = env
        config = env.config
        lane_y, half_width_m = 0.5 * config.lane_width_m, 0.5 * EgoVehicle.WIDTH + side_clearance_m
        stretch = [
            _stretch_in_strip(self._footprint(s_m), lane_y - half_width_m, lane_y + half_width_m)
            for s_m in np.arange(0.0, config.goal_m + 10.0, TABLE_STEP_M)
        ]
        self._covered_x = np.array(stretch)
        self._first_cell = int(np.argmax(np.isfinite(self._covered_x[:, 0])))
        """Where the ego car first reaches into the lane."""

    def clear(self, horizon_s: float, margin_m: float, plan: PedalPlan) -> bool:
        """Whether nothing comes within ``margin_m`` along the lane during ``horizon_s``."""
        time_s, s_m, _ = self._ego_motion(horizon_s, plan)
        cells = np.minimum((s_m / TABLE_STEP_M).astype(int), len(self._covered_x) - 1)
        if cells[-1] < self._first_cell:
            return True  # The ego car does not get as far as the lane.
        rear_x, front_x = self._covered_x[cells].T
        # All cars at once; the shape holds without any, too.
        cars = [(car.position[0], car.speed, car.LENGTH) for car in self.env.traffic]
        x, speed_mps, length_m = np.array(cars).reshape(-1, 3).T[:, :, None]
        car_x, reach_m = x + speed_mps * time_s, 0.5 * length_m + margin_m
        return not np.any((car_x + reach_m > rear_x) & (car_x - reach_m < front_x))

    def state_after(self, horizon_s: float, plan: PedalPlan) -> tuple[float, float]:
        """How far along the path the ego car is after ``horizon_s`` (m), and its speed (m/s)."""
        _, s_m, speed_mps = self._ego_motion(horizon_s, plan)
        return float(s_m[-1]), speed_mps

    def in_lane(self, s_m: float) -> bool:
        """Whether the ego car at this path length reaches into the traffic's way."""
        cell = min(int(s_m / TABLE_STEP_M), len(self._covered_x) - 1)
        return bool(np.isfinite(self._covered_x[cell, 0]))

    def _ego_motion(
        self, horizon_s: float, plan: PedalPlan
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Times ahead (s), arc lengths reached (m), an entry a control period; the last speed."""
        c, dt_s = self.env.config, self.env.config.control_period_s
        steps, held = round(horizon_s / dt_s), round(plan.hold_s / dt_s)
        held_mps2 = plan.pedal * (c.throttle_mps2 if plan.pedal > 0 else c.brake_mps2)
        speed_mps, s_m = self.env.ego.speed, self.env.distance_m
        positions = [s_m]
        for step in range(steps):
            # As the car itself: the position takes the speed at the start of the interval.
            s_m += speed_mps * dt_s
            if step < held:
                speed_mps = min(max(speed_mps + held_mps2 * dt_s, 0.0), c.max_speed_mps)
            elif plan.then_brake:
                speed_mps = max(speed_mps - plan.then_brake * c.brake_mps2 * dt_s, 0.0)
            elif plan.then_mps is not None and speed_mps < plan.then_mps:
                speed_mps = min(speed_mps + c.throttle_mps2 * dt_s, plan.then_mps)
            positions.append(s_m)
        return _instants(steps, dt_s), np.array(positions), speed_mps

    def _footprint(self, s_m: float) -> Rectangle:
        pose = self.env.path.pose(s_m)
        length_m, width_m = EgoVehicle.LENGTH, EgoVehicle.WIDTH
        # In the bend the tracked car points inwards by the slip angle.
        slip_rad = math.asin(0.5 * length_m * self.env.path.curvature(s_m))
        return Rectangle(pose.x, pose.y, pose.heading - slip_rad, length_m, width_m)


@cache
def _instants(steps: int, dt_s: float) -> NDArray[np.float64]:
    return np.linspace(0.0, steps * dt_s, steps + 1)


def _stretch_in_strip(shape: Rectangle, low_y: float, high_y: float) -> tuple[float, float]:
    """The x range that a rectangle covers between two y values; empty is (inf, -inf)."""
    points = corners(shape)
    xs: list[float] = []
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if low_y <= y0 <= high_y:
            xs.append(x0)
        for level in (low_y, high_y):
            if (y0 - level) * (y1 - level) < 0:
                xs.append(x0 + (x1 - x0) * (level - y0) / (y1 - y0))
    return (min(xs), max(xs)) if xs else (math.inf, -math.inf)
