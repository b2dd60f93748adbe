"""``phil/Congestion-v0``: a car hemmed in by others in highway congestion (section VI).

The learner has the steering wheel; the intelligent driver model has the pedals and follows
whoever is ahead. The cars around cover the lane markings, and the one ahead is no guide: each
keeps a place of its own within its lane.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from highway_env.road.road import Road
from numpy.typing import NDArray

from trainer.scenarios.congestion_config import CongestionConfig
from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.environment import (
    Action,
    DrivingEnv,
    Observation,
    Scene,
    Step,
    start_speed_mps,
)
from trainer.scenarios.geometry import Rectangle, overlap
from trainer.scenarios.idm import idm_acceleration
from trainer.scenarios.jam import LANES, spawn_jam, straight_road
from trainer.scenarios.rasteriser import ROWS, Rasteriser
from trainer.scenarios.traffic import TrafficVehicle
from trainer.scenarios.vehicle_types import CAR


class CongestionEnv(DrivingEnv):
    """Congestion as a gymnasium environment; the action is the steering angle (eq. 29), negative
    to the left, in shares of ``lambda_rad``.
    """

    scenario = "congestion"
    action_names = ("steering",)
    config: CongestionConfig

    def __init__(
        self,
        config: CongestionConfig | None = None,
        render_mode: str | None = None,
        scene: Scene = "nominal",
    ) -> None:
        super().__init__(render_mode)
        self.config = c = config or CongestionConfig.of(scene)
        self.road_width_m = LANES * c.lane_width_m
        self.network = straight_road(c.lane_width_m, c.goal_m)
        road = Rectangle(0.0, 0.0, 0.0, 4.0 * c.goal_m, self.road_width_m)
        self.rasteriser = Rasteriser(
            -c.view_behind_m, -0.5 * ROWS * c.metres_per_pixel, c.metres_per_pixel, [road]
        )
        self._steering = self._last_steering = 0.0
        self._braking = False

    @property
    def brake_action(self) -> Action:
        """What a simulator applies when commands stop: the last steering. ``press_brake``, too."""
        return np.array([self._steering], dtype=np.float32)

    @property
    def view_corner_m(self) -> tuple[float, float]:
        """Where on the ground the upper left corner of the policy's picture is, metres."""
        return float(self.ego.position[0]) + self.rasteriser.left_m, self.rasteriser.top_m

    def press_brake(self, pressed: bool) -> None:
        """Full brake instead of the IDM, until released or reset: the simulator's safe stop."""
        self._braking = pressed

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the seed alone decides traffic and the ego car's place and speed.

        Option ``standing``: the ego car is at rest.
        """
        super().reset(seed=seed)
        c, random = self.config, self.np_random
        self.road = Road(network=self.network, np_random=random)
        offset_m, heading_rad, speed_mps = (
            float(random.uniform(*limits))
            for limits in (c.start_offset_m, c.start_heading_rad, c.ego_speed_mps)
        )
        speed_mps = start_speed_mps(speed_mps, options)
        self.ego = EgoVehicle(self.road, (0.0, offset_m), heading_rad, speed_mps)
        self.traffic = spawn_jam(self.road, self.ego, c, random)
        self._steering = self._last_steering = 0.0
        self._braking = False
        self.steps, self.distance_m = 0, 0.0
        return self._first_report()

    def step(self, action: Action) -> Step:
        """Hold the steering angle for one control interval."""
        c = self.config
        self._last_steering = self._steering
        self._steering = min(max(float(action[0]), -1.0), 1.0)
        acceleration_mps2 = self._pedals()
        for car in self.traffic:
            car.act()
        for car in self.traffic:
            car.step(c.control_period_s)
        self.ego.drive(
            acceleration_mps2,
            self._steering * c.lambda_rad,
            c.desired_speed_mps,
            c.control_period_s,
        )
        self.steps += 1
        self.distance_m = float(self.ego.position[0])
        return self._report()

    def scene(self) -> dict[str, Any]:
        """What a viewer needs to draw the scene; plain lists and numbers."""
        c = self.config
        start_m, end_m = -40.0, c.goal_m + 60.0
        line_y = [(lane - 0.5 * LANES) * c.lane_width_m for lane in range(1, LANES)]
        return {
            "roads": [[[start_m, 0.0], [end_m, 0.0]]],
            "road_width_m": self.road_width_m,
            "lane_lines": [[[start_m, y], [end_m, y]] for y in line_y],
            "path": [[0.0, 0.0], [c.goal_m, 0.0]],
            "goal": [c.goal_m, 0.0],
            "view": [float(self.ego.position[0]) - 18.0, -8.0],
            "vehicles": self._vehicles(),
        }

    def _pedals(self) -> float:
        """The ego car's acceleration in m/s2: the IDM's, or the brake's."""
        c, leader = self.config, self._leader()
        if self._braking:
            return -c.brake_mps2
        gap_m, closing_mps = math.inf, 0.0
        if leader is not None:
            gap_m = float(leader.position[0] - self.ego.position[0])
            gap_m -= 0.5 * (leader.LENGTH + self.ego.LENGTH)
            closing_mps = self.ego.speed - leader.speed
        wanted_mps2 = idm_acceleration(
            CAR, self.ego.speed, c.desired_speed_mps, gap_m, closing_mps, c.time_gap_factor
        )
        return max(wanted_mps2, -c.brake_mps2)

    def _leader(self) -> TrafficVehicle | None:
        """The nearest vehicle ahead in the ego car's corridor, whatever the lane."""
        x, y = self.ego.position.tolist()
        ahead = [
            car
            for car in self.traffic
            if car.position[0] > x and abs(car.position[1] - y) < 0.5 * (car.WIDTH + self.ego.WIDTH)
        ]
        return min(ahead, key=lambda car: float(car.position[0]), default=None)

    def _frame(self, ego: Rectangle, cars: list[Rectangle]) -> NDArray[np.uint8]:
        seen = [_seen_from(ego.x, shape) for shape in cars]
        return self.rasteriser.frame(seen, _seen_from(ego.x, ego))

    def _outcome(self, ego: Rectangle, cars: list[Rectangle]) -> str | None:
        if any(overlap(ego, car) for car in cars):
            return "collision"
        reach_m = 0.5 * (
            ego.length * abs(math.sin(ego.heading)) + ego.width * abs(math.cos(ego.heading))
        )
        if abs(ego.y) + reach_m > 0.5 * self.road_width_m:
            return "off_road"
        if self.distance_m >= self.config.goal_m:
            return "goal"
        return "timeout" if self.steps >= self.config.max_steps else None

    def _reward(self, outcome: str | None) -> float:
        """Eq. 32: goal, failure, and the cost of changing the steering."""
        change = abs(self._steering - self._last_steering)
        return -self.config.steer_weight * change + self._ending_reward(outcome)


def _seen_from(x: float, shape: Rectangle) -> Rectangle:
    """A rectangle as the picture has it, which moves along the road with the ego car."""
    return Rectangle(shape.x - x, *shape[1:])
