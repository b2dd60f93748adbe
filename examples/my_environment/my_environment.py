"""A cart must touch a dock gently: an environment with all optional attributes, on a page."""

from dataclasses import replace

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from trainer.learner.config import PHIL

DOCK = "mine/Dock-v0"
GENTLE = replace(PHIL, penalty=False)  # a row of the table of algorithms: take-overs cost nothing


class Dock(gymnasium.Env):
    """Sees distance (m) and speed (m/s), and sets the acceleration (m/s2)."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    control_period_s = 0.1
    action_names, action_units = ("acceleration",), ("m/s2",)
    brake_action = (-2.0,)
    keys = {"up": (1.0,), "down": (-2.0,)}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = Box(np.array([-1, 0], "f4"), np.array([12, 4], "f4"))
        self.action_space = Box(-2.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        """Stand 6 to 10 m before the dock."""
        super().reset(seed=seed)
        self.start_m = self.distance_m = self.np_random.uniform(6.0, 10.0)
        self.speed_mps = 0.0
        return self._observation(), self._info()

    def step(self, action):  # type: ignore[no-untyped-def]
        """Roll on for 0.1 s; no cart rolls back."""
        self.speed_mps = float(np.clip(self.speed_mps + 0.1 * float(action[0]), 0.0, 4.0))
        self.distance_m -= 0.1 * self.speed_mps
        docked, gentle = self.distance_m <= 0.0, self.speed_mps < 0.5
        info = self._info()
        if docked:
            info["outcome"] = "goal" if gentle else "collision"
        reward = (10.0 if gentle else -10.0) if docked else -0.05
        return self._observation(), reward, docked, False, info

    def render(self) -> np.ndarray:
        """Draw the cart and the dock, uint8 [60, 240, 3]."""
        picture = np.full((60, 240, 3), 230, np.uint8)
        picture[:, 220:] = (60, 60, 60)
        left = int(200 - 18 * max(self.distance_m, 0.0))
        picture[20:40, max(left, 0) : left + 20] = (40, 90, 200)
        return picture

    def expert(self) -> "Expert":
        return Expert(self)

    def _observation(self) -> np.ndarray:
        return np.array([self.distance_m, self.speed_mps], np.float32)

    def _info(self) -> dict:
        return {"distance_m": self.start_m - self.distance_m, "speed_mps": self.speed_mps}


class Expert:
    """Drives from the true state, and takes over if the cart is too fast or waits."""

    def __init__(self, env: Dock) -> None:
        self.env = env

    def act(self) -> np.ndarray:
        """Follow a speed that falls with the distance."""
        wanted_mps = min(2.0, 0.3 + 0.5 * self.env.distance_m)
        return np.clip([4.0 * (wanted_mps - self.env.speed_mps)], -2.0, 1.0)

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        speed_mps = self.env.speed_mps + 0.1 * float(policy_action[0])
        if speed_mps > 0.45 and speed_mps**2 > 3.0 * self.env.distance_m:
            return "collision"
        return "stuck" if speed_mps < 0.1 else None


if DOCK not in gymnasium.registry:
    gymnasium.register(DOCK, "my_environment:Dock", max_episode_steps=200)
