"""The ego car: highway-env's kinematic bicycle with a pedal, and a PI path tracker."""

from __future__ import annotations

import math

from highway_env.road.road import Road
from highway_env.utils import wrap_to_pi
from highway_env.vehicle.kinematics import Vehicle

from trainer.scenarios.geometry import Rectangle
from trainer.scenarios.path import LeftTurnPath


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
