"""The ego car of the left turn: its path, highway-env's bicycle with a pedal, and a PI tracker."""

from __future__ import annotations

import math
from typing import NamedTuple

from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import Road
from highway_env.utils import wrap_to_pi
from highway_env.vehicle.kinematics import Vehicle

from trainer.scenarios.picture import Rectangle


class Pose(NamedTuple):
    """Position in metres and heading in rad, highway-env's frame (y down)."""

    x: float
    y: float
    heading: float


class LeftTurnPath:
    """North along the side road, a quarter circle to the left, then west along the main road.

    Args:
        start: where the path begins (x, y), metres.
        straight_m: length before the arc.
        radius_m: radius of the arc.

    Arc length ``s`` counts from the start; beyond the arc the path goes on for ever.
    """

    def __init__(self, start: tuple[float, float], straight_m: float, radius_m: float) -> None:
        self.start_x, self.start_y = start
        self.straight_m = straight_m
        self.radius_m = radius_m
        self.arc_m = 0.5 * math.pi * radius_m
        self.centre_x = self.start_x - radius_m
        self.centre_y = self.start_y - straight_m

    def pose(self, s_m: float) -> Pose:
        """The pose at arc length ``s_m`` (metres)."""
        on_arc_m = s_m - self.straight_m
        if on_arc_m <= 0.0:
            return Pose(self.start_x, self.start_y - s_m, -0.5 * math.pi)
        if on_arc_m <= self.arc_m:
            angle = on_arc_m / self.radius_m
            x = self.centre_x + self.radius_m * math.cos(angle)
            y = self.centre_y - self.radius_m * math.sin(angle)
            return Pose(x, y, -0.5 * math.pi - angle)
        beyond_m = on_arc_m - self.arc_m
        return Pose(self.centre_x - beyond_m, self.centre_y - self.radius_m, -math.pi)

    def project(self, x: float, y: float) -> tuple[float, float]:
        """The nearest point of the path: its arc length and the offset to its right, metres."""
        if y >= self.centre_y:
            return self.start_y - y, x - self.start_x
        if x <= self.centre_x:
            offset_m = (self.centre_y - self.radius_m) - y
            return self.straight_m + self.arc_m + (self.centre_x - x), offset_m
        dx, dy = x - self.centre_x, self.centre_y - y
        angle = math.atan2(dy, dx)
        return self.straight_m + angle * self.radius_m, math.hypot(dx, dy) - self.radius_m

    def curvature(self, s_m: float) -> float:
        """Signed curvature at ``s_m``, 1/m; negative is a left turn (headings are clockwise)."""
        return -1.0 / self.radius_m if 0.0 < s_m - self.straight_m <= self.arc_m else 0.0

    def lanes(self, end_m: float, width_m: float) -> list[StraightLane | CircularLane]:
        """The same path as highway-env lanes, ending at arc length ``end_m``."""
        straight_end = (self.start_x, self.centre_y)
        arc = CircularLane(
            (self.centre_x, self.centre_y),
            self.radius_m,
            0.0,
            -0.5 * math.pi,
            clockwise=False,
            width=width_m,
        )
        exit_start = (self.centre_x, self.centre_y - self.radius_m)
        exit_m = max(end_m - self.straight_m - self.arc_m, 0.1)
        exit_end = (exit_start[0] - exit_m, exit_start[1])
        return [
            StraightLane((self.start_x, self.start_y), straight_end, width=width_m),
            arc,
            StraightLane(exit_start, exit_end, width=width_m),
        ]


class EgoVehicle(Vehicle):
    """The controlled car. It stands outside ``road.vehicles``, so that traffic never yields.

    It moves by ``highway_env.vehicle.kinematics.Vehicle.step``; what is added is a speed that
    stays within ``[0, max_speed_mps]`` and the accelerations of the last step.
    """

    MAX_STEERING_RAD = math.pi / 4
    speed: float
    heading: float

    def __init__(
        self, road: Road, position: tuple[float, float], heading: float, speed: float
    ) -> None:
        super().__init__(road, position, heading, speed)
        self.longitudinal_acceleration_mps2 = 0.0
        self.lateral_acceleration_mps2 = 0.0

    def drive(
        self, acceleration_mps2: float, steering_rad: float, max_speed_mps: float, dt_s: float
    ) -> None:
        """Hold an acceleration and a front-wheel angle for one step.

        The step's mean acceleration is bounded so that the speed stays in range: a pressed
        brake holds a standing car instead of driving it backwards.
        """
        before_mps, before_rad = self.speed, self.heading
        lowest, highest = -self.speed / dt_s, (max_speed_mps - self.speed) / dt_s
        self.action["acceleration"] = min(max(acceleration_mps2, lowest), highest)
        self.action["steering"] = steering_rad
        self.step(dt_s)
        # A plain float again: arithmetic on numpy's scalars is many times slower.
        self.heading = float(self.heading)
        self.speed = min(max(self.speed, 0.0), max_speed_mps)
        self.longitudinal_acceleration_mps2 = (self.speed - before_mps) / dt_s
        self.lateral_acceleration_mps2 = self.speed * (self.heading - before_rad) / dt_s

    def on_state_update(self) -> None:
        """No lane look-up: the planned path says where the car is."""

    @property
    def footprint(self) -> Rectangle:
        """The car's rectangle on the ground."""
        x, y = self.position.tolist()
        return Rectangle(x, y, self.heading, self.LENGTH, self.WIDTH)


class PathTracker:
    """PI control of the front wheels along a planned path (section VI, auxiliary functions).

    The proportional part acts on heading error and lateral offset, the integral part on the
    offset; the path's curvature is fed forward, so that the feedback only has to take up what the
    kinematic model leaves over.
    """

    HEADING_GAIN = 1.5
    OFFSET_GAIN_RAD_PER_M = 0.5
    INTEGRAL_GAIN_RAD_PER_MS = 0.1
    INTEGRAL_LIMIT_MS = 1.0

    def __init__(self, path: LeftTurnPath) -> None:
        self.path = path
        self.integral_ms = 0.0

    def steering(self, ego: EgoVehicle, s_m: float, offset_m: float, dt_s: float) -> float:
        """The front-wheel angle in rad for the car at arc length ``s_m``, ``offset_m`` right."""
        limit = self.INTEGRAL_LIMIT_MS
        self.integral_ms = min(max(self.integral_ms + offset_m * dt_s, -limit), limit)
        curvature = self.path.curvature(s_m)
        # In a bend the car's centre moves at the slip angle to its heading.
        slip_rad = math.asin(0.5 * ego.LENGTH * curvature)
        course_rad = self.path.pose(s_m).heading
        course_error = wrap_to_pi(course_rad - slip_rad - ego.heading)
        angle = (
            math.atan(2.0 * math.tan(slip_rad))
            + self.HEADING_GAIN * course_error
            - self.OFFSET_GAIN_RAD_PER_M * offset_m
            - self.INTEGRAL_GAIN_RAD_PER_MS * self.integral_ms
        )
        return min(max(angle, -ego.MAX_STEERING_RAD), ego.MAX_STEERING_RAD)
