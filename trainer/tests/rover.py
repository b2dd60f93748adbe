"""Another kind of robot. Importing this registers it, also in another process (--scenario)."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

ROVER = f"{__name__}:test/Rover-v0"
CAMERA = Box(0, 255, (12, 20, 3), np.uint8)


class Rover(gymnasium.Env):
    """Two wheels in metres a second; a camera, and numbers of which one has no bound."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = Dict(
        {"camera": CAMERA, "far": Box(-np.inf, np.inf, (1,)), "wheels": Box(-1, 3, (2,))}
    )
    action_space = Box(np.array([-1, 0], np.float32), np.array([3, 1], np.float32))
    action_names = ("left", "right")
    keys: ClassVar = {"ArrowUp": (3.0, 1.0), "KeyA": (-1.0, 0.0)}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.done: Any = np.zeros(2)

    def _seen(self):
        camera = self.np_random.integers(0, 255, CAMERA.shape).astype(np.uint8)
        return {
            "camera": camera,
            "far": np.full(1, 7.5, np.float32),
            "wheels": np.asarray(self.done, np.float32),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action):
        self.done = action
        return self._seen(), float(action[0]), False, False, {"is_success": action[0] > 2.9}

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)

    def expert(self):
        return Careful(self)


class Careful:
    def __init__(self, env):
        self.env = env

    def act(self):
        return np.array([3.0, 0.5])

    def wants_control(self, policy_action):
        return "slow" if policy_action[0] < 1.0 else None


class Dark(Rover):
    metadata = {}  # noqa: RUF012
    render = gymnasium.Env.render  # raises NotImplementedError


for name in ("Rover", "Dark"):
    gymnasium.register(f"test/{name}-v0", f"{__name__}:{name}", max_episode_steps=12)
