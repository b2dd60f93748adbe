"""Common parts of the scenarios: ego car, traffic, spaces, frames, and the result of a step.

Traffic is highway-env's IDM within a lane, the intelligent driver model of Treiber, Hennecke and
Helbing (2000); in the congestion it also controls the ego car's pedals. Cars are blind to the ego
car unless they follow it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.road.lane import StraightLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.utils import not_zero
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from trainer.learner.replay import FRAMES_LAYOUT, Action, Observation
from trainer.scenarios import Scene, picture
from trainer.scenarios.picture import COLUMNS, ROWS, Rasteriser, Rectangle, overlap

Step = tuple[Observation, float, bool, bool, dict[str, Any]]
Range = tuple[float, float]
FAILURES = ("collision", "off_road")


@dataclass(frozen=True)
class ScenarioConfig:
    """Numbers of every scenario."""

    control_period_s: float = 0.1  # Control interval of all vehicles (section VI-A)
    max_steps: int = 200  # Steps until the episode is cut off as a timeout
    goal_m: float = 0.0  # Distance from start to goal
    goal_reward: float = 10.0
    fail_reward: float = -10.0
    scaled: ClassVar[str]
    """The field that scales the third term of the reward; 1 in eq. 31 and 32 as printed."""


class EgoVehicle(Vehicle):
    """The controlled car. Traffic never looks for it, and so never yields.

    It moves as highway-env's ``Vehicle``; besides, its speed stays within ``[0, max_speed_mps]``,
    and it keeps the accelerations of the last step.
    """

    MAX_STEERING_RAD = math.pi / 4
    speed: float
    heading: float
    longitudinal_acceleration_mps2 = 0.0
    lateral_acceleration_mps2 = 0.0

    def drive(
        self, acceleration_mps2: float, steering_rad: float, max_speed_mps: float, dt_s: float
    ) -> None:
        """Hold an acceleration and a front-wheel angle for one step.

        The mean acceleration is bounded so that the speed stays in range: a pressed brake holds a
        standing car instead of driving it backwards.
        """
        before_mps, before_rad = self.speed, self.heading
        lowest, highest = -self.speed / dt_s, (max_speed_mps - self.speed) / dt_s
        self.action["acceleration"] = min(max(acceleration_mps2, lowest), highest)
        self.action["steering"] = steering_rad
        self.step(dt_s)
        # A plain float: arithmetic on numpy's scalars is many times slower.
        self.heading = float(self.heading)
        self.speed = min(max(self.speed, 0.0), max_speed_mps)
        self.longitudinal_acceleration_mps2 = (self.speed - before_mps) / dt_s
        self.lateral_acceleration_mps2 = self.speed * (self.heading - before_rad) / dt_s

    def on_state_update(self) -> None:
        """Skip the lane look-up: the planned path says where the car is."""


@dataclass(frozen=True)
class VehicleType:
    """Size and IDM parameters of one kind of vehicle."""

    length_m: float
    width_m: float
    acceleration_mps2: float  # Comfortable acceleration (IDM's a)
    deceleration_mps2: float  # Comfortable deceleration (IDM's b)
    time_gap_s: float  # Time gap to the leader (IDM's T)
    standstill_gap_m: float = 2.0  # Bumper to bumper at rest (IDM's s0)


CAR = VehicleType(5.0, 2.0, 3.0, 5.0, 0.8)
BUBBLE_CAR = replace(CAR, length_m=2.3, width_m=1.4)
SMALL_CAR = replace(CAR, length_m=3.6, width_m=1.65)
COMPACT_CAR = replace(CAR, length_m=4.3, width_m=1.8)
LARGE_CAR = replace(CAR, length_m=5.3, width_m=2.1)
VAN = VehicleType(6.5, 2.16, 2.6, 4.5, 1.0)
TRUCK = VehicleType(7.1, 2.4, 1.3, 4.0, 1.2)
MOTORCYCLE = VehicleType(2.2, 0.9, 6.0, 10.0, 0.6)

Mix = tuple[tuple[VehicleType, float], ...]  # Vehicle types and their shares, which sum to 1
CARS_ONLY: Mix = tuple((car, 0.2) for car in (BUBBLE_CAR, SMALL_CAR, COMPACT_CAR, CAR, LARGE_CAR))
"""Traffic of the nominal scenes."""
MIXED: Mix = ((CAR, 0.4), (VAN, 0.2), (TRUCK, 0.2), (MOTORCYCLE, 0.2))
"""Traffic of the variant scenes (section VII-D: more types and amounts of vehicles)."""


def draw_types(mix: Mix, count: int, random: np.random.Generator) -> list[VehicleType]:
    """Draw the types of ``count`` vehicles."""
    chosen = random.choice(len(mix), size=count, p=[share for _, share in mix])
    return [mix[number][0] for number in chosen]


def bodies_m(behind: VehicleType, ahead: VehicleType) -> float:
    """Return the distance of the centres of two vehicles that touch, bumper to bumper."""
    return 0.5 * (behind.length_m + ahead.length_m)


def equip(
    cars: list[TrafficVehicle], types: list[VehicleType], time_gap_factor: float = 1.0
) -> None:
    """Give each vehicle, after its leader, its type's size and IDM parameters.

    ``time_gap_factor``: factor on the type's time gap; drivers close up in a jam.
    """
    for car, kind in zip(cars, types, strict=True):
        car.LENGTH, car.WIDTH = kind.length_m, kind.width_m
        car.COMFORT_ACC_MAX = kind.acceleration_mps2
        car.COMFORT_ACC_MIN = -kind.deceleration_mps2
        car.TIME_WANTED = time_gap_factor * kind.time_gap_s
        # highway-env's IDM takes distances from centre to centre.
        bodies = kind.length_m if car.leader is None else 0.5 * (car.LENGTH + car.leader.LENGTH)
        car.DISTANCE_WANTED = kind.standstill_gap_m + bodies


class TrafficVehicle(IDMVehicle):
    """An aggressive driver: keeps its lane, follows its leader closely, yields to nobody.

    Only the longitudinal half of ``IDMVehicle`` is used: a car in a straight lane needs no lane
    choice, and its leader never changes. That takes the neighbour search, most of the cost of a
    step, out of the loop. All lanes with traffic lead along x, so that a place is one number.
    """

    def __init__(
        self,
        road: Road,
        lane_index: LaneIndex,
        position_m: float,
        speed_mps: float,
        leader: Vehicle | None,
    ) -> None:
        lane = road.network.get_lane(lane_index)
        # Without a road at first: highway-env would search all lanes for the one named here.
        super().__init__(
            None, lane.position(position_m, 0.0), lane.heading_at(position_m), speed_mps,
            target_lane_index=lane_index, target_speed=speed_mps, enable_lane_change=False,
        )  # fmt: skip
        self.road, self.lane, self.lane_index = road, lane, lane_index
        self._start_m = float(lane.start[0])
        self.leader = leader

    def act(self, action: dict | str | None = None) -> None:
        """Choose the acceleration by the intelligent driver model; the wheels stay straight."""
        acceleration = min(max(self._wanted_mps2(), -self.ACC_MAX), self.ACC_MAX)
        self.action = {"steering": 0.0, "acceleration": acceleration}

    def _wanted_mps2(self) -> float:
        """``IDMVehicle.acceleration`` to the bit, on plain numbers: several times as fast."""
        a, speed = self.COMFORT_ACC_MAX, max(self.speed, 0.0)
        # numpy's power, as there: Python's differs in the last bit.
        wanted = a * (1.0 - float(np.power(speed / abs(not_zero(self.target_speed)), self.DELTA)))
        if self.leader is None:
            return wanted
        leader = self.leader
        closing_mps = self.speed - leader.speed * math.cos(leader.heading)
        approach_m = self.speed * closing_mps / (2.0 * math.sqrt(-a * self.COMFORT_ACC_MIN))
        gap_m = self.DISTANCE_WANTED + self.speed * self.TIME_WANTED + approach_m
        # Positions along the lane, from its start.
        x, ahead_x = self.position.item(0), leader.position.item(0)
        share = gap_m / not_zero((ahead_x - self._start_m) - (x - self._start_m))
        return wanted - a * (share * share)

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds. A car that has braked to a stop stands: it never reverses."""
        acceleration = max(self.action["acceleration"], -self.speed / dt)
        self.position[0] += self.speed * dt
        self.speed += acceleration * dt


def footprint(car: Vehicle) -> Rectangle:
    x, y = car.position.tolist()
    return Rectangle(x, y, float(car.heading), car.LENGTH, car.WIDTH)


def straight_lanes(
    ends: tuple[str, str], start_m: float, end_m: float, middles_m: list[float], width_m: float
) -> RoadNetwork:
    """Make highway-env's lanes along x, side by side; ``middles_m`` are their y."""
    network = RoadNetwork()
    for y in middles_m:
        # No speed limit: the cars' own desired speeds are what limits them.
        lane = StraightLane((start_m, y), (end_m, y), width_m, speed_limit=None)
        network.add_lane(*ends, lane)
    return network


def queue(
    road: Road, lane_index: LaneIndex, positions_m: list[float], speeds_mps: list[float]
) -> list[TrafficVehicle]:
    """Put cars into a lane at falling distances along it; each follows the car before it.

    Each speed is a car's initial and desired one.
    """
    cars: list[TrafficVehicle] = []
    for position_m, speed_mps in zip(positions_m, speeds_mps, strict=True):
        leader = cars[-1] if cars else None
        cars.append(TrafficVehicle(road, lane_index, position_m, speed_mps, leader))
    return cars


class DrivingEnv(gymnasium.Env[Observation, Action]):
    """A scenario as a gymnasium environment.

    Observation: uint8 [2, 45, 80], frames [t-1, t]. Action: float32 [1] in [-1, 1]. ``info`` holds
    ``distance_m``, ``speed_mps``, the accelerations of the step and, at the end, ``outcome``.

    A scenario builds its road (``_build``), places its vehicles (``_place``), moves them in
    ``step`` (``_move``), says whether the episode has ended (``_outcome``) and rates a step
    (``_reward``); ``_frame`` draws the policy's picture.
    """

    car: Any  # The fields of ``edge_runtime.manifest.Car``, for a robot in the car's place
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's form)
    scenario: str
    observation_name = "frames"
    layout = FRAMES_LAYOUT
    observation_meanings: ClassVar = {"frames": "grey pictures from above, [t-1, t]"}
    action_names: tuple[str, ...]
    action_meanings: tuple[str, ...]
    action_units: tuple[str, ...]
    action_range = (np.full(1, -1.0, np.float32), np.full(1, 1.0, np.float32))
    rest_action = np.zeros(1, np.float32)  # Hands off
    keys: Mapping[str, tuple[float, ...]]  # Key -> the action while a person holds it
    key_rate_per_s: float  # Change of the action while a key is held
    biased_action: float  # The wrong action of biased guidance
    expert_class: str  # A name, because its module imports the scenario
    scenes: ClassVar[Mapping[Scene, Any]]  # Their configs
    config: ScenarioConfig
    ego: EgoVehicle
    traffic: list[TrafficVehicle]
    network: RoadNetwork
    rasteriser: Rasteriser

    def __init__(
        self, config: Any = None, render_mode: str | None = None, scene: Scene = "nominal"
    ) -> None:
        self.config, self.render_mode = config or self.scenes[scene], render_mode
        self.observation_space = spaces.Box(0, 255, (2, ROWS, COLUMNS), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.frames = np.zeros((2, ROWS, COLUMNS), np.uint8)
        self.steps = 0
        self.distance_m = 0.0
        self.control_period_s, self.goal_m = self.config.control_period_s, self.config.goal_m
        self._build()

    def expert(self) -> Any:
        """Make the scripted human; ``wants_control(action)`` says when and why it takes over."""
        return resolve_name(self.expert_class)(self)

    def render(self) -> NDArray[np.uint8]:
        """Draw the scene from above for a person, uint8 [height, width, 3]."""
        return picture.draw_scene(self.scene())

    def scene(self) -> dict[str, Any]:
        """Describe the scene for viewers, in plain lists and numbers."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the seed alone decides traffic and the ego car's start.

        Option ``standing``: the ego car is at rest, as a robot is at an episode's start.
        """
        super().reset(seed=seed)
        self.road = Road(network=self.network, np_random=self.np_random)
        self.steps, self.distance_m = 0, 0.0
        self._place()
        if (options or {}).get("standing", False):
            self.ego.speed = 0.0
        self.frames[:] = self._frame(*self._footprints())
        return self.frames.copy(), self._info(None)

    def _build(self) -> None:
        """Make the network and the rasteriser, which all episodes share."""
        raise NotImplementedError

    def _place(self) -> None:
        """Put the ego car and the traffic on the road, always drawing in the same order."""
        raise NotImplementedError

    def _frame(self, ego: Rectangle, cars: list[Rectangle]) -> NDArray[np.uint8]:
        """Draw the policy's picture, uint8 [45, 80], of ego car and traffic."""
        return self.rasteriser.frame(cars, ego)

    def _outcome(self, ego: Rectangle) -> str | None:
        """Return "goal" or "off_road" if the ego car, with this footprint, is there, else None."""
        raise NotImplementedError

    def _reward(self, outcome: str | None) -> float:
        raise NotImplementedError

    def _move(self, acceleration_mps2: float, steering_rad: float, max_speed_mps: float) -> None:
        period_s = self.config.control_period_s
        for car in self.traffic:
            car.act()
        for car in self.traffic:
            car.step(period_s)
        self.ego.drive(acceleration_mps2, steering_rad, max_speed_mps, period_s)
        self.steps += 1

    def _report(self) -> Step:
        ego, cars = self._footprints()
        self.frames[0] = self.frames[1]
        self.frames[1] = self._frame(ego, cars)
        outcome = "collision" if any(overlap(ego, car) for car in cars) else self._outcome(ego)
        if outcome is None and self.steps >= self.config.max_steps:
            outcome = "timeout"
        terminated = outcome == "goal" or outcome in FAILURES
        info = self._info(outcome)
        return self.frames.copy(), self._reward(outcome), terminated, outcome == "timeout", info

    def _footprints(self) -> tuple[Rectangle, list[Rectangle]]:
        return footprint(self.ego), [footprint(car) for car in self.traffic]

    def _ending_reward(self, outcome: str | None) -> float:
        """Return the terms of goal and failure, the first two of eq. 31 and 32."""
        if outcome == "goal":
            return self.config.goal_reward
        return self.config.fail_reward if outcome in FAILURES else 0.0

    def _vehicles(self) -> list[dict[str, Any]]:
        """Describe the scene's vehicles, the ego car first."""
        cars: list[EgoVehicle | TrafficVehicle] = [self.ego, *self.traffic]
        return [
            dict(zip(picture.BODY, footprint(car), strict=True))
            | {"id": number, "speed_mps": float(car.speed), "ego": number == 0}
            for number, car in enumerate(cars)
        ]

    def _info(self, outcome: str | None) -> dict[str, Any]:
        info = {
            "distance_m": self.distance_m,
            "speed_mps": self.ego.speed,
            "lateral_acceleration_mps2": self.ego.lateral_acceleration_mps2,
            "longitudinal_acceleration_mps2": self.ego.longitudinal_acceleration_mps2,
        }
        return info if outcome is None else {**info, "outcome": outcome}
