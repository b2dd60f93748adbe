"""``phil/LeftTurn-v0``: an unprotected left turn from a side road into a main road (section VI).

The learner has the pedal; a PI controller steers along the planned path. Traffic on the main
road crosses the path from the left and never yields.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.road.road import Road
from numpy.typing import NDArray

from trainer.scenarios.ego import EgoVehicle, PathTracker
from trainer.scenarios.geometry import Rectangle, overlap
from trainer.scenarios.path import LeftTurnPath
from trainer.scenarios.rasteriser import COLUMNS, ROWS, Rasteriser
from trainer.scenarios.roads import LANE_REACH_M, NEAR_LANE, road_areas, t_intersection
from trainer.scenarios.scene import draw_scene
from trainer.scenarios.traffic import TrafficVehicle, queue

Observation = NDArray[np.uint8]
Range = tuple[float, float]


@dataclass(frozen=True)
class LeftTurnConfig:
    """Every number of the scenario."""

    control_period_s: float = 0.1
    """Control interval of all vehicles (section VI-A)."""
    max_steps: int = 200
    """Steps until the episode is cut off as a timeout."""
    lane_width_m: float = 4.0
    straight_m: float = 10.0
    """Path on the side road before the turn."""
    turn_radius_m: float = 6.0
    goal_m: float = 21.0
    """Path length from start to goal."""
    stop_line_m: float = 6.0
    """Where a waiting car stands; its nose is then 1.5 m short of the main road."""
    ego_speed_mps: Range = (3.0, 5.0)
    """Initial speed of the ego car."""
    max_speed_mps: float = 6.0
    throttle_mps2: float = 3.0
    """Acceleration at full pedal (+1)."""
    brake_mps2: float = 4.0
    """Deceleration at full brake (-1)."""
    traffic_cars: int = 3
    traffic_speed_mps: Range = (4.0, 6.0)
    """Initial and desired speed of each car of the main road (section VI-A)."""
    first_car_m: Range = (2.0, 12.0)
    """Distance of the first car before the middle of the crossing: too near to turn before it."""
    short_gap_m: Range = (10.0, 16.0)
    """A gap nobody can use, centre to centre."""
    long_gap_m: Range = (32.0, 42.0)
    """A gap that a driver who is ready can use."""
    long_gap_share: float = 0.5
    """How often a gap is a long one."""
    target_speed_mps: float = 5.0
    """Target of the reward's speed term (eq. 31)."""
    goal_reward: float = 10.0
    fail_reward: float = -10.0
    speed_weight: float = 0.02
    """Scale of the speed term. With gamma 0.95 and 10 Hz the horizon is 2 s: seen from the stop
    line the goal, 30 steps off, is worth 10 x 0.95^30 = 2.1, a crash 15 steps off -4.6, waiting
    for ever -100 x this weight. The literal weight 1 makes an early crash the best policy; below
    0.046 waiting for ever is better than crashing, and 0.02 leaves a margin."""
    view_left_m: float = -30.0
    view_top_m: float = -6.0
    metres_per_pixel: float = 0.5
    """The picture shows 40 m x 22.5 m of ground and does not move: 30 m of the main road to the
    left, so that a car at 6 m/s is seen for longer than the turn takes."""


class LeftTurnEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """The left turn as a gymnasium environment.

    Observation: uint8 [2, 45, 80], frames [t-1, t]. Action: float32 [1] in [-1, 1], the pedal
    aperture (eq. 30). ``info``: ``distance_m``, ``speed_mps``, the accelerations of the step
    and, at the end, ``outcome``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's form)
    scenario = "left_turn"
    brake_action = np.array([-1.0], dtype=np.float32)
    """The action that stops the car: what a simulator applies when commands stop."""

    def __init__(
        self, config: LeftTurnConfig | None = None, render_mode: str | None = None
    ) -> None:
        self.config = config or LeftTurnConfig()
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (2, ROWS, COLUMNS), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        c = self.config
        half = 0.5 * c.lane_width_m
        # Right-hand traffic: the ego car comes up the right lane of the side road, crosses the
        # near lane of the main road (y > 0, eastbound) and ends in its far lane (y < 0).
        self.path = LeftTurnPath((half, c.straight_m + c.lane_width_m), c.straight_m, 3 * half)
        self.rasteriser = Rasteriser(c.view_left_m, c.view_top_m, c.metres_per_pixel)
        self.road_areas = road_areas(c.lane_width_m)
        self._background = self.rasteriser.background(self.road_areas)
        self.network = t_intersection(self.path, c.goal_m, c.lane_width_m)
        self.frames = np.zeros((2, ROWS, COLUMNS), np.uint8)
        self.steps = 0
        self.distance_m = 0.0
        self._offset_m = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the seed alone decides traffic and initial speed."""
        super().reset(seed=seed)
        c, random = self.config, self.np_random
        self.road = Road(network=self.network, np_random=random)
        self.traffic = self._spawn_traffic()
        start = self.path.pose(0.0)
        speed_mps = float(random.uniform(*c.ego_speed_mps))
        self.ego = EgoVehicle(self.road, (start.x, start.y), start.heading, speed_mps)
        self.tracker = PathTracker(self.path)
        self.steps, self.distance_m, self._offset_m = 0, 0.0, 0.0
        self.frames[:] = self._frame()
        return self.frames.copy(), self._info(None)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold the pedal for one control interval."""
        c = self.config
        pedal = min(max(float(action[0]), -1.0), 1.0)
        acceleration_mps2 = pedal * (c.throttle_mps2 if pedal > 0 else c.brake_mps2)
        steering_rad = self.tracker.steering(
            self.ego, self.distance_m, self._offset_m, c.control_period_s
        )
        for car in self.traffic:
            car.act()
        for car in self.traffic:
            car.step(c.control_period_s)
        self.ego.drive(acceleration_mps2, steering_rad, c.max_speed_mps, c.control_period_s)
        self.steps += 1
        self.distance_m, self._offset_m = self.path.project(*self.ego.position.tolist())
        self.frames[0] = self.frames[1]
        self.frames[1] = self._frame()
        outcome = self._outcome()
        terminated = outcome in ("goal", "collision", "off_road")
        info = self._info(outcome)
        return self.frames.copy(), self._reward(outcome), terminated, outcome == "timeout", info

    def render(self) -> NDArray[np.uint8]:
        """The scene from above for a person, uint8 [height, width, 3]."""
        return draw_scene(self.scene(), self.frames, self._caption())

    def scene(self) -> dict[str, Any]:
        """What a viewer needs to draw the scene; plain lists and numbers."""
        c = self.config
        far_m = 40.0
        path = [self.path.pose(0.1 * i * c.goal_m / 2) for i in range(21)]
        goal = self.path.pose(c.goal_m)
        ego = _vehicle_dict(0, self.ego.footprint, self.ego.speed, ego=True)
        others = [
            _vehicle_dict(i + 1, car.footprint, car.speed, ego=False)
            for i, car in enumerate(self.traffic)
        ]
        width_m = 2 * c.lane_width_m
        return {
            "roads": [[[-far_m, 0.0], [far_m, 0.0]], [[0.0, 0.0], [0.0, far_m]]],
            "road_width_m": width_m,
            "path": [[pose.x, pose.y] for pose in path],
            "goal": [goal.x, goal.y],
            "stop_line": list(self.path.pose(c.stop_line_m + 0.5 * self.ego.LENGTH)[:2]),
            "vehicles": [ego, *others],
        }

    def _spawn_traffic(self) -> list[TrafficVehicle]:
        c, random = self.config, self.np_random
        crossing_m = LANE_REACH_M + 0.5 * c.lane_width_m
        positions: list[float] = []
        for _ in range(c.traffic_cars):
            if positions:
                gap_m = c.long_gap_m if random.random() < c.long_gap_share else c.short_gap_m
                positions.append(positions[-1] - float(random.uniform(*gap_m)))
            else:
                positions.append(crossing_m - float(random.uniform(*c.first_car_m)))
        speeds = [float(v) for v in random.uniform(*c.traffic_speed_mps, size=c.traffic_cars)]
        return queue(self.road, NEAR_LANE, positions, speeds)

    def _frame(self) -> NDArray[np.uint8]:
        cars = [car.footprint for car in self.traffic]
        return self.rasteriser.frame(self._background, cars, self.ego.footprint)

    def _outcome(self) -> str | None:
        ego = self.ego.footprint
        if any(overlap(ego, car.footprint) for car in self.traffic):
            return "collision"
        if self.distance_m >= self.config.goal_m:
            return "goal"
        if abs(self._offset_m) > 0.5 * self.config.lane_width_m:
            return "off_road"
        return "timeout" if self.steps >= self.config.max_steps else None

    def _reward(self, outcome: str | None) -> float:
        """Eq. 31: goal, failure, and the distance to the target speed."""
        c = self.config
        reward = -c.speed_weight * abs(self.ego.speed - c.target_speed_mps)
        if outcome == "goal":
            reward += c.goal_reward
        elif outcome in ("collision", "off_road"):
            reward += c.fail_reward
        return reward

    def _info(self, outcome: str | None) -> dict[str, Any]:
        info = {
            "distance_m": self.distance_m,
            "speed_mps": self.ego.speed,
            "lateral_acceleration_mps2": self.ego.lateral_acceleration_mps2,
            "longitudinal_acceleration_mps2": self.ego.longitudinal_acceleration_mps2,
        }
        return info if outcome is None else {**info, "outcome": outcome}

    def _caption(self) -> str:
        time_s, goal_m = self.steps * self.config.control_period_s, self.config.goal_m
        return f"{time_s:.1f} s\n{self.ego.speed:.1f} m/s\n{self.distance_m:.1f} of {goal_m:.0f} m"


def _vehicle_dict(number: int, shape: Rectangle, speed_mps: float, ego: bool) -> dict[str, Any]:
    return {
        "id": number,
        "x": shape.x,
        "y": shape.y,
        "heading_rad": shape.heading,
        "length_m": shape.length,
        "width_m": shape.width,
        "speed_mps": float(speed_mps),
        "ego": ego,
    }
