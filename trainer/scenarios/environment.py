"""The base of the scenarios: the ego car, spaces, the two frames, and the report of a step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Any, ClassVar, Self

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from trainer.learner.replay import FRAMES_LAYOUT, Action, Observation
from trainer.scenarios import Scene
from trainer.scenarios.picture import BODY, COLUMNS, ROWS, Rasteriser, Rectangle, draw_scene
from trainer.scenarios.traffic import TrafficVehicle, footprint

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
    scaled: ClassVar[str]  # The field that scales the third term of the reward

    def with_printed_reward(self) -> Self:
        """Return a copy with eq. 31 or 32 as it is printed, but for the latter's sign."""
        change: dict[str, Any] = {self.scaled: 1.0}
        return replace(self, **change)


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
    key_rate_per_s: float  # How quickly a key presses
    biased_action: float  # The wrong action of biased guidance
    expert_class: str  # By its name: its module imports the scenario
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
        return draw_scene(self.scene())

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
        """Draw the policy's picture, uint8 [45, 80], from the footprints of ego car and traffic."""
        return self.rasteriser.frame(cars, ego)

    def _outcome(self, ego: Rectangle, cars: list[Rectangle]) -> str | None:
        """Return how the episode has ended, or None, from the same footprints."""
        raise NotImplementedError

    def _reward(self, outcome: str | None) -> float:
        raise NotImplementedError

    def _move(self, acceleration_mps2: float, steering_rad: float, max_speed_mps: float) -> None:
        """Move all vehicles by one step, the ego car as told."""
        for car in self.traffic:
            car.act()
        for car in self.traffic:
            car.step(self.config.control_period_s)
        period_s = self.config.control_period_s
        self.ego.drive(acceleration_mps2, steering_rad, max_speed_mps, period_s)
        self.steps += 1

    def _report(self) -> Step:
        """Return the result of ``step``, after the vehicles have moved."""
        ego, cars = self._footprints()
        self.frames[0] = self.frames[1]
        self.frames[1] = self._frame(ego, cars)
        outcome = self._outcome(ego, cars)
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
            dict(zip(BODY, footprint(car), strict=True))
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
