"""A car on a straight road. Importing this registers it, also in another process (--env)."""

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

GOAL_M = 14.0
PERIOD_S = 0.1


class ToyEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Full pedal is 3 m/s2, full brake -4 m/s2; the picture's brightness follows the distance."""

    scenario, action_names, observation_name = "left_turn", ("pedal",), "frames"
    control_period_s = PERIOD_S

    def __init__(self, goal_m=GOAL_M, max_steps=80, wall_s=0.0) -> None:
        self.observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.brake_action = np.array([-1.0], np.float32)
        self._goal_m, self._max_steps, self._wall_s = goal_m, max_steps, wall_s

    def reset(self, *, seed=None, options=None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps, self._distance_m = 0, 0.0
        self._speed_mps = float(self.np_random.uniform(3.0, 5.0))
        self._frames = np.zeros((2, 45, 80), np.uint8)
        return self._frames.copy(), self._info(0.0, None)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        time.sleep(self._wall_s)
        acceleration = float(action[0]) * (3.0 if action[0] > 0 else 4.0)
        self._speed_mps = max(0.0, self._speed_mps + acceleration * PERIOD_S)
        self._distance_m += self._speed_mps * PERIOD_S
        self._steps += 1
        self._frames[0] = self._frames[1]
        self._frames[1] = int(self._distance_m * 12) % 190
        arrived = self._distance_m >= self._goal_m
        late = self._steps >= self._max_steps
        outcome = "goal" if arrived else "timeout" if late else None
        return self._frames.copy(), 0.1, arrived, late, self._info(acceleration, outcome)

    def scene(self) -> dict[str, Any]:
        car = {"id": 0, "x": self._distance_m, "y": 0.0, "heading_rad": 0.0, "length_m": 4.0}
        car |= {"width_m": 1.8, "speed_mps": np.float64(self._speed_mps), "ego": True}
        return {
            "roads": [[[-10.0, 0.0], [30.0, 0.0]]],
            "road_width_m": 4.0,
            "path": np.array([[0.0, 0.0], [self._goal_m, 0.0]]),
            "goal": [self._goal_m, 0.0],
            "vehicles": [car],
            "step": -self._steps,  # In a message stands ours.
        }

    def _info(self, acceleration_mps2: float, outcome: str | None) -> dict[str, Any]:
        info: dict[str, Any] = {
            "distance_m": self._distance_m,
            "speed_mps": self._speed_mps,
            "lateral_acceleration_mps2": 0.0,
            "longitudinal_acceleration_mps2": acceleration_mps2,
        }
        return info | ({"outcome": outcome} if outcome else {})


VARIANTS: dict[str, dict[str, float]] = {
    "BridgeToy-v0": {},
    # Long, and slow enough for a person (or a test) to kill something in the middle.
    "BridgeToySlow-v0": {"goal_m": 1000.0, "max_steps": 60, "wall_s": 0.02},
}
for name, options in VARIANTS.items():
    if name not in gymnasium.registry:
        made: Any = {"entry_point": "hil_tests.tests.shared.environments:ToyEnv", "kwargs": options}
        gymnasium.register(name, **made, disable_env_checker=True, order_enforce=False)
