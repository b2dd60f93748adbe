"""What the scenarios share: spaces, the two frames, what a step reports, and the picture."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.picture import COLUMNS, ROWS, Rasteriser, Rectangle
from trainer.scenarios.scene import draw_scene, vehicle_entry
from trainer.scenarios.traffic import TrafficVehicle

Observation = NDArray[np.uint8]
Action = NDArray[np.float32]
Step = tuple[Observation, float, bool, bool, dict[str, Any]]
Range = tuple[float, float]
Scene = Literal["nominal", "variant", "dense"]
"""The trained scene; one with more vehicles and other types of them (section VII-D); one whose
traffic stands closer and leaves less to do right."""
FAILURES = ("collision", "off_road")


def start_speed_mps(drawn_mps: float, options: dict[str, Any] | None) -> float:
    """The ego car's speed at the start: as drawn, or 0 with the option ``standing`` of ``reset``.

    A robot starts every episode standing. All else stays as the seed has it.
    """
    return 0.0 if (options or {}).get("standing", False) else drawn_mps


class ScenarioConfig(Protocol):
    """The numbers that every scenario has."""

    @property
    def control_period_s(self) -> float:
        """Control interval, s."""

    @property
    def max_steps(self) -> int:
        """Steps until the timeout."""

    @property
    def goal_m(self) -> float:
        """Distance from start to goal, m."""

    @property
    def goal_reward(self) -> float:
        """The reward of the goal."""

    @property
    def fail_reward(self) -> float:
        """The reward of a failure."""


class DrivingEnv(gymnasium.Env[Observation, Action]):
    """A scenario as a gymnasium environment.

    Observation: uint8 [2, 45, 80], frames [t-1, t]. Action: float32 [1] in [-1, 1]. ``info``:
    ``distance_m``, ``speed_mps``, the accelerations of the step and, at the end, ``outcome``.

    A scenario moves its vehicles in ``step`` and says what is seen (``_frame``), whether it has
    ended (``_outcome``), and what the step is worth (``_reward``).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's form)
    scenario: str
    action_names: tuple[str, ...]
    config: ScenarioConfig
    ego: EgoVehicle
    traffic: list[TrafficVehicle]
    rasteriser: Rasteriser

    def __init__(self, render_mode: str | None) -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (2, ROWS, COLUMNS), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.frames = np.zeros((2, ROWS, COLUMNS), np.uint8)
        self.steps = 0
        self.distance_m = 0.0

    def render(self) -> NDArray[np.uint8]:
        """The scene from above for a person, uint8 [height, width, 3]."""
        return draw_scene(self.scene(), self.frames, self._caption())

    @property
    def view_corner_m(self) -> tuple[float, float]:
        """Where on the ground the upper left corner of the policy's picture is, metres."""
        return self.rasteriser.left_m, self.rasteriser.top_m

    def scene(self) -> dict[str, Any]:
        """What a viewer needs to draw the scene; plain lists and numbers."""
        raise NotImplementedError

    def _frame(self, ego: Rectangle, cars: list[Rectangle]) -> NDArray[np.uint8]:
        """What the policy sees now, uint8 [45, 80]: from the footprints of ego car and traffic."""
        raise NotImplementedError

    def _outcome(self, ego: Rectangle, cars: list[Rectangle]) -> str | None:
        """How the episode has ended, or None; from the same footprints."""
        raise NotImplementedError

    def _reward(self, outcome: str | None) -> float:
        """The reward of the step."""
        raise NotImplementedError

    def _first_report(self) -> tuple[Observation, dict[str, Any]]:
        """What ``reset`` returns: the same frame twice."""
        self.frames[:] = self._frame(*self._footprints())
        return self.frames.copy(), self._info(None)

    def _report(self) -> Step:
        """What ``step`` returns, after the vehicles have moved."""
        ego, cars = self._footprints()
        self.frames[0] = self.frames[1]
        self.frames[1] = self._frame(ego, cars)
        outcome = self._outcome(ego, cars)
        terminated = outcome == "goal" or outcome in FAILURES
        info = self._info(outcome)
        return self.frames.copy(), self._reward(outcome), terminated, outcome == "timeout", info

    def _footprints(self) -> tuple[Rectangle, list[Rectangle]]:
        """Of the ego car and of each car of the traffic."""
        return self.ego.footprint, [car.footprint for car in self.traffic]

    def _ending_reward(self, outcome: str | None) -> float:
        """Goal and failure: the first two terms of eq. 31 and 32."""
        if outcome == "goal":
            return self.config.goal_reward
        return self.config.fail_reward if outcome in FAILURES else 0.0

    def _vehicles(self) -> list[dict[str, Any]]:
        """The scene's vehicles, the ego car first."""
        others = [
            vehicle_entry(number, car.footprint, car.speed, ego=False)
            for number, car in enumerate(self.traffic, start=1)
        ]
        return [vehicle_entry(0, self.ego.footprint, self.ego.speed, ego=True), *others]

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
