"""Environments for tests. Importing this registers them, also in another process (--env).

`ToyEnv` is a car on a straight road; `Plain` and what follows have one oddity each.
"""

import os
import time
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces import Box

GOAL_M = 14.0
PERIOD_S = 0.1


class ToyEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Full pedal is 3 m/s2, full brake -4 m/s2; the picture's brightness follows the distance."""

    scenario, action_names, observation_name = "left_turn", ("pedal",), "frames"
    control_period_s = PERIOD_S

    def __init__(self, goal_m=GOAL_M, max_steps=80, wall_s=0.0, reward=0.1) -> None:
        self.observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.brake_action = np.array([-1.0], np.float32)
        self._goal_m, self._max_steps, self._wall_s = goal_m, max_steps, wall_s
        self._reward = reward

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
        return self._frames.copy(), self._reward, arrived, late, self._info(acceleration, outcome)

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
    "BridgeToyShort-v0": {"max_steps": 25},
    # Long, and slow enough for a person (or a test) to kill something in the middle.
    "BridgeToySlow-v0": {"goal_m": 1000.0, "max_steps": 60, "wall_s": 0.02},
    "BridgeToyNan-v0": {"reward": float("nan")},
}
for name, options in VARIANTS.items():
    if name not in gymnasium.registry:
        made: Any = {"entry_point": "hil_tests.testing.environments:ToyEnv", "kwargs": options}
        gymnasium.register(name, **made, disable_env_checker=True, order_enforce=False)
SHORT_PARKING = "BridgeParking-v0"  # One of highway-env's, which alone has 100 s
if SHORT_PARKING not in gymnasium.registry:
    parking, less = "highway_env.envs.parking_env:ParkingEnv", {"config": {"duration": 6}}
    gymnasium.register(SHORT_PARKING, parking, kwargs=less)


class Plain(gymnasium.Env[Any, Any]):
    """Counts its steps, up to 20, and says nothing of itself."""

    metadata = {}  # noqa: RUF012
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    observation_space: Any = Box(-1e7, 1e7, (3,), np.float32)

    def scene(self) -> Any:
        return {}

    def seen(self) -> Any:
        return np.full(3, self.steps / 10, np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.seed, self.steps = seed, 0
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.seen(), float(-abs(action[0])), False, False, {}


class Guessed(Plain):
    metadata = {"render_fps": 20}  # noqa: RUF012


class HasDt(Guessed):
    dt = 0.05


class HasFrequency(HasDt):
    config: ClassVar[dict[str, Any]] = {"policy_frequency": 5}


class Says(HasFrequency):
    control_period_s = 0.25


class NoRenderMode(Plain):
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self) -> None:
        pass


class Single(Plain):
    """Only one may live in a process."""

    control_period_s, alive = 0.1, False

    def __init__(self) -> None:
        if Single.alive:
            raise RuntimeError("another instance of this simulator is alive in this process")
        Single.alive = True

    def close(self) -> None:
        Single.alive = False


class WritesAction(Plain):
    control_period_s = 0.1

    def step(self, action: Any) -> Any:
        action *= 0.5
        action += 0.25
        return super().step(action)


class FloatPicture(Plain):
    control_period_s = 0.1
    observation_space = Box(0, 255, (1, 16, 16), np.uint8)
    shown: ClassVar[Any] = np.full((1, 16, 16), 0.9, np.float32)

    def seen(self) -> Any:
        return self.shown


class Wanders(Single):
    """Changes the working directory in every call."""

    def __init__(self) -> None:
        os.chdir("/tmp")

    def step(self, action: Any) -> Any:
        os.chdir("/")
        return super().step(action)


class Huge(Plain):
    control_period_s = 0.1

    def seen(self) -> Any:
        return np.full(3, 1e6, np.float32)


class Tells(Plain):
    """Tells of its goals; every third seed comes to none."""

    control_period_s = 0.1

    def step(self, action: Any) -> Any:
        *seen, info = super().step(action)
        if self.steps == 10 and (self.seed or 0) % 3:
            seen[2], info = True, {"outcome": "goal", "lateral_acceleration_mps2": -2.0}
        return *seen, info


class Offers(gymnasium.Wrapper[Any, Any, Any, Any]):
    """All that an environment may offer, where people put it."""

    control_period_s, action_names, observation_name = 0.2, ("pedal",), "numbers"
    key_rate_per_s, brake_action = 2.0, (-1.0,)
    keys: ClassVar[dict[str, Any]] = {"w": (1.0,)}

    def __init__(self) -> None:
        super().__init__(WritesAction())
        self.pressed: list[bool] = []

    def press_brake(self, pressed: bool) -> None:
        self.pressed.append(pressed)

    def scene(self) -> dict[str, Any]:
        return {"road_width_m": 4.0}

    def expert(self) -> Any:
        return self

    def act(self) -> Any:
        return [0.5]

    def wants_control(self, action: Any) -> None:
        return None


for kind in (
    Plain, Guessed, HasDt, HasFrequency, Says, NoRenderMode, Single, WritesAction, FloatPicture,
    Wanders, Huge, Tells, Offers,
):  # fmt: skip
    gymnasium.register(f"odd/{kind.__name__}-v0", kind, max_episode_steps=20)  # type: ignore[arg-type]


def odd(name: str) -> str:
    """How it is asked for."""
    return f"{__name__}:odd/{name}-v0"
