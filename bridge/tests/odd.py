"""Environments with one oddity each. Importing this registers them, also in another process."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box


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


def register(*kinds: Any) -> None:
    """Register environments as odd/NAME-v0, which end after 20 steps."""
    for kind in kinds:
        gymnasium.register(f"odd/{kind.__name__}-v0", kind, max_episode_steps=20)


register(
    Plain, Guessed, HasDt, HasFrequency, Says, NoRenderMode, WritesAction, FloatPicture, Offers
)


def odd(name: str) -> str:
    """How it is asked for."""
    return f"{__name__}:odd/{name}-v0"
