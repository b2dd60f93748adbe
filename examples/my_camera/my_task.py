"""Describe the camera policy's observation and action, as an environment of the recorded pictures.

Only a training needs it. Nothing moves in it: the policy learns a person's recorded actions.
"""

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from my_camera import HEIGHT, WIDTH, Pictures

from edge_runtime.manifest import Car

TASK = "mine/Camera-v0"


class CameraTask(gymnasium.Env):
    """Shows the pictures in order, whatever the action; there is no reward."""

    control_period_s = 0.1
    observation_name, action_names = "frames", ("pedal", "steering")
    brake_action = (-1.0, 0.0)
    # The driven car is the robot itself, a Hunter 2.0 driven gently: so its scale is 1.
    car = Car(
        throttle_mps2=1.0, brake_mps2=2.0, max_speed_mps=1.5, full_steering_rad=0.38,
        wheelbase_m=0.65,
    )  # fmt: skip
    observation_space = Box(0, 255, (2, HEIGHT, WIDTH), np.uint8)
    action_space = Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        super().reset(seed=seed)
        self.source = Pictures()
        return self.source.observe()["frames"], {}

    def step(self, action):  # type: ignore[no-untyped-def]
        return self.source.observe()["frames"], 0.0, False, False, {}

    def expert(self) -> "Nobody":
        """Make a human who never takes over: the person's drives are recorded already."""
        return Nobody()


class Nobody:
    def act(self) -> np.ndarray:
        return np.zeros(2, np.float32)

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        return None


if TASK not in gymnasium.registry:
    gymnasium.register(TASK, "my_task:CameraTask", max_episode_steps=100)
