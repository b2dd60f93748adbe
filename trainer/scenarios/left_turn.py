"""``phil/LeftTurn-v0``: an unprotected left turn from a side road into a main road (section VI)."""

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.utils import wrap_to_pi

from trainer.scenarios import Scene, base
from trainer.scenarios.picture import Rasteriser, Rectangle

LANE_REACH_M = 100.0  # How far the main road goes on to either side
SIDE_ROAD_M = 40.0
NEAR_LANE: LaneIndex = ("west", "east", 0)
"""The lane of the main road that the ego car must cross; it then joins the far lane."""
HEADING_GAIN = 1.5
OFFSET_GAIN_RAD_PER_M = 0.5
INTEGRAL_GAIN_RAD_PER_MS = 0.1
INTEGRAL_LIMIT_MS = 1.0
"""Gains and limit of the PI control that keeps the car on its path."""


class Pose(NamedTuple):
    """Position in metres and heading in rad, highway-env's frame (y down)."""

    x: float
    y: float
    heading: float


class LeftTurnPath:
    """North along the side road, a quarter circle to the left, then west along the main road.

    Arc length ``s`` counts from the start (x, y); beyond the arc the path goes on for ever.
    """

    def __init__(self, start: tuple[float, float], straight_m: float, radius_m: float) -> None:
        self.start_x, self.start_y = start
        self.straight_m = straight_m
        self.radius_m = radius_m
        self.arc_m = 0.5 * math.pi * radius_m
        self.centre_x = self.start_x - radius_m
        self.centre_y = self.start_y - straight_m

    def pose(self, s_m: float) -> Pose:
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
        """Return the arc length of the nearest point of the path, and the offset to its right."""
        if y >= self.centre_y:
            return self.start_y - y, x - self.start_x
        if x <= self.centre_x:
            offset_m = (self.centre_y - self.radius_m) - y
            return self.straight_m + self.arc_m + (self.centre_x - x), offset_m
        dx, dy = x - self.centre_x, self.centre_y - y
        angle = math.atan2(dy, dx)
        return self.straight_m + angle * self.radius_m, math.hypot(dx, dy) - self.radius_m

    def curvature(self, s_m: float) -> float:
        """Return the curvature at ``s_m``, 1/m; negative in a left turn (headings: clockwise)."""
        return -1.0 / self.radius_m if 0.0 < s_m - self.straight_m <= self.arc_m else 0.0


@dataclass(frozen=True)
class LeftTurnConfig(base.ScenarioConfig):
    scaled = "speed_weight"
    lane_width_m: float = 4.0
    straight_m: float = 10.0  # Path on the side road before the turn
    turn_radius_m: float = 6.0
    goal_m: float = 21.0  # Path length from start to goal
    stop_line_m: float = 6.0
    """Path length of a waiting car; its nose is then 1.5 m short of the main road."""
    ego_speed_mps: base.Range = (3.0, 5.0)  # Initial speed of the ego car
    max_speed_mps: float = 6.0
    throttle_mps2: float = 3.0  # Acceleration at full pedal (+1)
    brake_mps2: float = 4.0  # Deceleration at full brake (-1)
    traffic_cars: int = 3
    traffic_mix: base.Mix = base.CARS_ONLY
    traffic_speed_mps: base.Range = (4.0, 6.0)
    """Initial and desired speed of each car of the main road (section VI-A)."""
    first_car_m: base.Range = (2.0, 12.0)
    """Distance of the first car before the middle of the crossing: too near to turn before it."""
    short_gap_m: base.Range = (10.0, 16.0)
    """A gap too short to turn, centre to centre of cars; longer vehicles get longer gaps."""
    long_gap_m: base.Range = (32.0, 42.0)  # A gap long enough for a driver who is ready
    long_gap_share: float = 0.5  # Share of the gaps that are long
    target_speed_mps: float = 5.0  # Target of the reward's speed term (eq. 31).
    speed_weight: float = 0.02
    """Scale of the speed term. With gamma 0.95 and 10 Hz the horizon is 2 s: from the stop line the
    goal, 30 steps off, is worth 10 x 0.95^30 = 2.1, a crash 15 steps off -4.6, and waiting for ever
    -100 x this weight. The literal weight 1 makes an early crash the best policy; below 0.046
    waiting for ever is better than crashing, and 0.02 leaves a margin."""
    view_left_m: float = -30.0
    view_top_m: float = -6.0
    metres_per_pixel: float = 0.5
    """The picture shows 40 m x 22.5 m of ground and does not move: 30 m of the main road to the
    left, so that a car at 6 m/s is seen for longer than the turn takes."""


SCENES: dict[Scene, LeftTurnConfig] = {
    "nominal": LeftTurnConfig(),
    # More vehicles may take longer than 20 s to pass; waiting for them must not time out.
    "variant": LeftTurnConfig(traffic_cars=5, traffic_mix=base.MIXED, max_steps=300),
    # A longer queue whose gaps all come from one range, neither clearly long nor clearly short. The
    # scripted expert takes no gap under 16 m and every gap over 25 m; between them the two cars'
    # speeds decide, so a policy that has only met gaps up to 16 m and from 32 m on must have
    # learned more than to tell those apart. Half of the range is such near-ties, a third unusable.
    "dense": LeftTurnConfig(
        traffic_cars=6, long_gap_m=(12.0, 28.0), long_gap_share=1.0, max_steps=400
    ),
}


class LeftTurnEnv(base.DrivingEnv):
    """The left turn as a gymnasium environment; the action is the pedal aperture (eq. 30)."""

    scenario = "left_turn"
    action_names = ("pedal",)
    action_meanings = ("positive opens the throttle, negative brakes",)
    action_units = ("aperture",)
    keys = MappingProxyType({"up": (1.0,), "w": (1.0,), "down": (-1.0,), "s": (-1.0,)})
    key_rate_per_s = 5.0  # A key presses the pedal fully in 0.2 s.
    biased_action = 1.0  # Full throttle.
    expert_class = "trainer.human.left_turn:LeftTurnHuman"
    scenes = SCENES
    config: LeftTurnConfig
    brake_action = np.array([-1.0], dtype=np.float32)
    """The action that stops the car; a simulator applies it when commands stop."""

    def _build(self) -> None:
        c = self.config
        half = 0.5 * c.lane_width_m
        # Right-hand traffic: the ego car comes up the right lane of the side road, crosses the
        # near lane of the main road (y > 0, eastbound) and ends in its far lane (y < 0).
        start = (half, c.straight_m + c.lane_width_m)
        self.path = LeftTurnPath(start, c.straight_m, c.turn_radius_m)
        width_m = 2 * c.lane_width_m
        paved = [
            Rectangle(0.0, 0.0, 0.0, 2 * LANE_REACH_M, width_m),
            Rectangle(0.0, 0.5 * SIDE_ROAD_M, 0.5 * math.pi, SIDE_ROAD_M, width_m),
        ]
        self.rasteriser = Rasteriser(c.view_left_m, c.view_top_m, c.metres_per_pixel, paved)
        # The one lane in which there is traffic; y = 0 is its left edge.
        self.network = base.straight_lanes(
            NEAR_LANE[:2], -LANE_REACH_M, LANE_REACH_M, [half], c.lane_width_m
        )
        self._offset_m = self._integral_ms = 0.0

    @property
    def car(self) -> dict[str, float]:
        """The car for the policy file; full steering is the path control's limit."""
        c = self.config
        return {
            "throttle_mps2": c.throttle_mps2,
            "brake_mps2": c.brake_mps2,
            "max_speed_mps": c.max_speed_mps,
            "full_steering_rad": base.EgoVehicle.MAX_STEERING_RAD,
            "wheelbase_m": base.EgoVehicle.LENGTH,
        }

    def step(self, action: base.Action) -> base.Step:
        c = self.config
        pedal = min(max(float(action[0]), -1.0), 1.0)
        acceleration_mps2 = pedal * (c.throttle_mps2 if pedal > 0 else c.brake_mps2)
        self._move(acceleration_mps2, self._steering_rad(), c.max_speed_mps)
        self.distance_m, self._offset_m = self.path.project(*self.ego.position.tolist())
        return self._report()

    def _steering_rad(self) -> float:
        """Steer along the planned path by PI control (section VI, auxiliary functions).

        The proportional part acts on heading error and lateral offset, the integral part on the
        offset; the path's curvature is fed forward.
        """
        ego, limit, dt_s = self.ego, INTEGRAL_LIMIT_MS, self.config.control_period_s
        self._integral_ms = min(max(self._integral_ms + self._offset_m * dt_s, -limit), limit)
        # In a bend the car's centre moves at the slip angle to its heading.
        slip_rad = math.asin(0.5 * ego.LENGTH * self.path.curvature(self.distance_m))
        course_rad = self.path.pose(self.distance_m).heading
        course_error = wrap_to_pi(course_rad - slip_rad - ego.heading)
        angle = (
            math.atan(2.0 * math.tan(slip_rad))
            + HEADING_GAIN * course_error
            - OFFSET_GAIN_RAD_PER_M * self._offset_m
            - INTEGRAL_GAIN_RAD_PER_MS * self._integral_ms
        )
        return min(max(angle, -ego.MAX_STEERING_RAD), ego.MAX_STEERING_RAD)

    def pedal_for_speed(self, speed_mps: float) -> float:
        """Return the pedal in [-1, 1] that brings the car closest to this speed in one step.

        A simulator that follows a real vehicle uses it; errors do not add up.
        """
        c = self.config
        wanted_mps2 = (speed_mps - self.ego.speed) / c.control_period_s
        pedal = wanted_mps2 / (c.throttle_mps2 if wanted_mps2 > 0 else c.brake_mps2)
        return min(max(pedal, -1.0), 1.0)

    def scene(self) -> dict[str, Any]:
        c = self.config
        far_m = 40.0
        path = [self.path.pose(0.1 * i * c.goal_m / 2) for i in range(21)]
        goal = self.path.pose(c.goal_m)
        width_m = 2 * c.lane_width_m
        return {
            "roads": [[[-far_m, 0.0], [far_m, 0.0]], [[0.0, 0.0], [0.0, far_m]]],
            "road_width_m": width_m,
            "path": [[pose.x, pose.y] for pose in path],
            "goal": [goal.x, goal.y],
            "vehicles": self._vehicles(),
        }

    def _place(self) -> None:
        self.traffic = self._spawn_traffic()
        start = self.path.pose(0.0)
        speed_mps = float(self.np_random.uniform(*self.config.ego_speed_mps))
        self.ego = base.EgoVehicle(self.road, (start.x, start.y), start.heading, speed_mps)
        self._offset_m = self._integral_ms = 0.0

    def _spawn_traffic(self) -> list[base.TrafficVehicle]:
        c, random = self.config, self.np_random
        crossing_m = LANE_REACH_M + 0.5 * c.lane_width_m
        types = base.draw_types(c.traffic_mix, c.traffic_cars, random)
        positions: list[float] = []
        for number in range(c.traffic_cars):
            if positions:
                gap_m = c.long_gap_m if random.random() < c.long_gap_share else c.short_gap_m
                longer_m = base.bodies_m(types[number], types[number - 1]) - base.CAR.length_m
                positions.append(positions[-1] - float(random.uniform(*gap_m)) - longer_m)
            else:
                positions.append(crossing_m - float(random.uniform(*c.first_car_m)))
        speeds = [float(v) for v in random.uniform(*c.traffic_speed_mps, size=c.traffic_cars)]
        cars = base.queue(self.road, NEAR_LANE, positions, speeds)
        base.equip(cars, types)
        return cars

    def _outcome(self, ego: Rectangle) -> str | None:
        if self.distance_m >= self.config.goal_m:
            return "goal"
        return "off_road" if abs(self._offset_m) > 0.5 * self.config.lane_width_m else None

    def _reward(self, outcome: str | None) -> float:
        """Rate goal, failure, and the distance to the target speed (eq. 31)."""
        c = self.config
        speed_term = -c.speed_weight * abs(self.ego.speed - c.target_speed_mps)
        return speed_term + self._ending_reward(outcome)
