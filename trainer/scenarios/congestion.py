"""``phil/Congestion-v0``: a car hemmed in by others in highway congestion (section VI)."""

import itertools
import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainer.scenarios import Scene, base
from trainer.scenarios.picture import ROWS, Rasteriser, Rectangle


@dataclass(frozen=True)
class CongestionConfig(base.ScenarioConfig):
    scaled = "steer_weight"
    max_steps: int = 300  # At 4 m/s the goal takes 200
    lane_width_m: float = 3.5
    goal_m: float = 80.0
    lambda_rad: float = 0.15
    """Front-wheel angle at full action: eq. 29's 5 lambda pi. With 5 pi rad of steering wheel for
    the front wheels' 45 degrees, lambda is 0.19. At 5 m/s the heading then changes by at most
    0.015 rad a step: enough to save a car 2 s before it touches its neighbour."""
    start_offset_m: base.Range = (-0.3, 0.3)  # The ego car's place in its lane at the start
    start_heading_rad: base.Range = (-0.05, 0.05)
    """Its heading: at the edges of this range the wheels held straight lead 4 m aside."""
    ego_speed_mps: base.Range = (4.0, 6.0)  # Initial speed of the ego car
    desired_speed_mps: float = 6.0
    """Target of the IDM on the ego car's pedals (section VI-A), and of cars with a leader."""
    brake_mps2: float = 4.0
    """Maximum deceleration of the ego car, also of a safe stop."""
    traffic_speed_mps: base.Range = (4.0, 6.0)  # Initial speeds of traffic (section VI-A)
    jam_speed_mps: base.Range = (4.5, 5.5)  # Speed of the whole jam
    lane_speed_mps: base.Range = (-0.5, 0.5)
    """Speed of each lane's first car relative to the jam. At 2 m/s the lanes would drift apart, and
    the ego car would be alone before half of the way."""
    side_cars: int = 3
    """Cars in each neighbouring lane; with one ahead and one behind, eight are within 20 m."""
    cars_behind: int = 1
    """Cars that follow the ego car in its lane. Cars in other lanes never react to it."""
    traffic_mix: base.Mix = base.CARS_ONLY
    side_front_m: base.Range = (9.0, 13.0)
    """Distance to each neighbouring lane's first car, centre to centre."""
    gap_m: base.Range = (3.5, 5.5)  # Between bumpers in a lane, at the start
    ahead_gap_m: base.Range = (4.0, 9.0)  # From the ego car to the one ahead of it
    time_gap_factor: float = 0.5  # Share of a vehicle's usual time gap that is kept in the jam
    lane_offset_m: base.Range = (-0.2, 0.2)
    """Where in its lane each car drives; the narrowest gap then leaves 1.3 m to each side of an
    ego car in mid-lane, in the variant 1.1 m."""
    steer_weight: float = 0.1
    """Cost of a unit change of the action (eq. 32 is printed without the minus sign that its text
    demands). With gamma 0.95 and 10 Hz the horizon is 2 s. A correction (the action out, across and
    back, 2 in all) costs 0.2; the crash that it avoids is worth -3.6 seen 20 steps ahead and -0.8
    seen 50 ahead, so correcting early pays. With weight 1 waiting for the last second would pay;
    worse, random trembling (2/3 a step) would cost 13 in discounted sum, and an early crash, which
    is -10, would be a beginner's best policy. With 0.1 trembling costs 1.3: felt, and never worth a
    crash."""
    metres_per_pixel: float = 0.375
    view_behind_m: float = 12.0
    """The picture shows 30 m x 16.9 m of ground with all three lanes. It moves along the road with
    the ego car, and neither turns nor moves aside: place and heading show as they are, and other
    cars' movement between the two frames shows their speed relative to the ego car's."""


SCENES: dict[Scene, CongestionConfig] = {
    "nominal": CongestionConfig(),
    "variant": CongestionConfig(side_cars=4, cars_behind=2, traffic_mix=base.MIXED),
    # A jam in lanes as narrow as at roadworks, in which cars keep to their lane's middle, and lanes
    # to the jam's speed, about half as well as usual. The narrowest gap leaves 0.5 m to each side
    # of an ego car in mid-lane instead of 1.25, and its walls move; were it narrower, cars of two
    # lanes would touch. Gaps along a lane are from 2 to 8 m, so that the walls have holes, too; a
    # lane's queue is long enough to be there until the goal.
    "dense": CongestionConfig(
        lane_width_m=2.9, lane_offset_m=(-0.35, 0.35), lane_speed_mps=(-1.0, 1.0), side_cars=6,
        side_front_m=(14.0, 22.0), cars_behind=2, gap_m=(2.0, 8.0), ahead_gap_m=(2.5, 9.0),
    ),
}  # fmt: skip
LANES = 3
EGO_LANE = 1  # The middle one, y = 0; lane 0 is to its left
REACH_M = 200.0  # How far the road goes on before start and goal
EXPONENT = 4.0  # Of the intelligent driver model
LEAST_GAP_M = 0.1
"""Smaller gaps count as this, so that none is divided by 0; at 0 the cars crash anyway."""


class CongestionEnv(base.DrivingEnv):
    """Congestion as a gymnasium environment.

    The action is the steering angle (eq. 29) in shares of ``lambda_rad``, negative to the left.
    """

    scenario = "congestion"
    action_names = ("steering",)
    action_meanings = ("positive turns right, negative left (eq. 29)",)
    action_units = (f"share of the front wheels' {CongestionConfig().lambda_rad:g} rad",)
    keys = MappingProxyType({"left": (-1.0,), "a": (-1.0,), "right": (1.0,), "d": (1.0,)})
    key_rate_per_s = 2.5  # A tap turns the wheel a little.
    biased_action = 0.5  # Half of the full angle.
    expert_class = "trainer.human.congestion:CongestionHuman"
    scenes = SCENES
    config: CongestionConfig

    def _build(self) -> None:
        c = self.config
        self.road_width_m = LANES * c.lane_width_m
        middles_m = [(lane - EGO_LANE) * c.lane_width_m for lane in range(LANES)]
        self.network = base.straight_lanes(
            ("start", "end"), -REACH_M, c.goal_m + REACH_M, middles_m, c.lane_width_m
        )
        road = Rectangle(0.0, 0.0, 0.0, 4.0 * c.goal_m, self.road_width_m)
        self.rasteriser = Rasteriser(
            -c.view_behind_m, -0.5 * ROWS * c.metres_per_pixel, c.metres_per_pixel, [road]
        )
        self._steering = 0.0

    @property
    def car(self) -> dict[str, float]:
        """The car for the policy file; the IDM sets the throttle, and action +1 turns right."""
        c = self.config
        return {
            "throttle_mps2": base.CAR.acceleration_mps2,
            "brake_mps2": c.brake_mps2,
            "max_speed_mps": c.desired_speed_mps,
            "full_steering_rad": -c.lambda_rad,
            "wheelbase_m": base.EgoVehicle.LENGTH,
        }

    @property
    def brake_action(self) -> base.Action:
        """The last steering, applied when commands stop; ``press_brake`` does the braking."""
        return np.array([self._steering], dtype=np.float32)

    def press_brake(self, pressed: bool) -> None:
        """Brake fully instead of following the IDM, until released or reset: the safe stop."""
        self._braking = pressed

    def step(self, action: base.Action) -> base.Step:
        c = self.config
        self._last_steering = self._steering
        self._steering = min(max(float(action[0]), -1.0), 1.0)
        self._move(self._pedals(), self._steering * c.lambda_rad, c.desired_speed_mps)
        self.distance_m = float(self.ego.position[0])
        return self._report()

    def scene(self) -> dict[str, Any]:
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

    def _place(self) -> None:
        c, random = self.config, self.np_random
        offset_m, heading_rad, speed_mps = (
            float(random.uniform(*limits))
            for limits in (c.start_offset_m, c.start_heading_rad, c.ego_speed_mps)
        )
        self.ego = base.EgoVehicle(self.road, (0.0, offset_m), heading_rad, speed_mps)
        self.traffic = self._spawn_traffic()
        self._steering = self._last_steering = 0.0
        self._braking = False

    def _spawn_traffic(self) -> list[base.TrafficVehicle]:
        c, random = self.config, self.np_random
        jam_mps = float(random.uniform(*c.jam_speed_mps))
        cars: list[base.TrafficVehicle] = []
        for lane in range(LANES):
            first_mps = jam_mps + float(random.uniform(*c.lane_speed_mps))
            types, x = self._own_lane() if lane == EGO_LANE else self._side_lane()
            speeds = [float(v) for v in random.uniform(*c.traffic_speed_mps, size=len(x))]
            places = [REACH_M + place for place in x]
            own = base.queue(self.road, ("start", "end", lane), places, speeds)
            for car in own:
                car.target_speed = c.desired_speed_mps
            if lane == EGO_LANE and c.cars_behind:
                own[1].leader = self.ego
            base.equip(own, types, c.time_gap_factor)
            # A lane's first car drives at the jam's speed; the others want to go faster.
            own[0].speed = own[0].target_speed = first_mps
            cars += own
        for car in cars:
            car.position[1] += float(random.uniform(*c.lane_offset_m))
        return cars

    def _side_lane(self) -> tuple[list[base.VehicleType], list[float]]:
        """Draw a neighbouring lane's vehicles, and their places along it in m."""
        c, random = self.config, self.np_random
        types = base.draw_types(c.traffic_mix, c.side_cars, random)
        x = [float(random.uniform(*c.side_front_m))]
        for ahead, behind in itertools.pairwise(types):
            x.append(x[-1] - base.bodies_m(behind, ahead) - float(random.uniform(*c.gap_m)))
        return types, x

    def _own_lane(self) -> tuple[list[base.VehicleType], list[float]]:
        """Draw the ego lane's vehicles and places, one ahead; those behind follow the ego car."""
        c, random = self.config, self.np_random
        types = base.draw_types(c.traffic_mix, 1 + c.cars_behind, random)
        nose_m = 0.5 * base.EgoVehicle.LENGTH
        x = [nose_m + float(random.uniform(*c.ahead_gap_m)) + 0.5 * types[0].length_m]
        tail_m = -nose_m
        for kind in types[1:]:
            x.append(tail_m - float(random.uniform(*c.gap_m)) - 0.5 * kind.length_m)
            tail_m = x[-1] - 0.5 * kind.length_m
        return types, x

    def _pedals(self) -> float:
        """Return the ego car's acceleration in m/s2: the IDM's, or the brake's."""
        c, leader = self.config, self._leader()
        if self._braking:
            return -c.brake_mps2
        gap_m, closing_mps = math.inf, 0.0
        if leader is not None:
            gap_m = float(leader.position[0] - self.ego.position[0])
            gap_m -= 0.5 * (leader.LENGTH + self.ego.LENGTH)
            closing_mps = self.ego.speed - leader.speed
        return max(self._idm_mps2(gap_m, closing_mps), -c.brake_mps2)

    def _idm_mps2(self, gap_m: float, closing_mps: float) -> float:
        """Follow a leader ``gap_m`` ahead, bumper to bumper, and ``closing_mps`` slower."""
        car, speed_mps = base.CAR, self.ego.speed
        a, b = car.acceleration_mps2, car.deceleration_mps2
        time_gap_m = speed_mps * self.config.time_gap_factor * car.time_gap_s
        approach_m = speed_mps * closing_mps / (2.0 * math.sqrt(a * b))
        wanted_m = car.standstill_gap_m + max(0.0, time_gap_m + approach_m)
        free = 1.0 - (speed_mps / self.config.desired_speed_mps) ** EXPONENT
        return a * (free - (wanted_m / max(gap_m, LEAST_GAP_M)) ** 2)

    def _leader(self) -> base.TrafficVehicle | None:
        """Return the nearest vehicle ahead in the ego car's corridor, in any lane."""
        x, y = self.ego.position.tolist()
        width_m = self.ego.WIDTH
        ahead = [car for car in self.traffic if car.position[0] > x
                 and abs(car.position[1] - y) < 0.5 * (car.WIDTH + width_m)]  # fmt: skip
        return min(ahead, key=lambda car: float(car.position[0]), default=None)

    def _frame(self, ego: Rectangle, cars: list[Rectangle]) -> NDArray[np.uint8]:
        # The picture moves along the road with the ego car.
        cars = [shape._replace(x=shape.x - ego.x) for shape in cars]
        return self.rasteriser.frame(cars, ego._replace(x=0.0))

    def _outcome(self, ego: Rectangle) -> str | None:
        reach_m = 0.5 * (
            ego.length * abs(math.sin(ego.heading)) + ego.width * abs(math.cos(ego.heading))
        )
        if abs(ego.y) + reach_m > 0.5 * self.road_width_m:
            return "off_road"
        return "goal" if self.distance_m >= self.config.goal_m else None

    def _reward(self, outcome: str | None) -> float:
        """Rate goal, failure, and the change of the steering (eq. 32)."""
        change = abs(self._steering - self._last_steering)
        return -self.config.steer_weight * change + self._ending_reward(outcome)
