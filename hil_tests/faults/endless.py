"""A drive without an end, that takes its orders from files: an environment for the campaign.

The directory is named by PHIL_FAULT_DIR. ``end`` in it ends the episode, ``bright`` turns the
frames white (a policy made for it then becomes slow), and every press and release of the brake
is written to ``brakes`` with its monotonic time. Importing this registers PhilEndless-v0.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE

DIRECTORY = "PHIL_FAULT_DIR"
ENVIRONMENT = "hil_tests.faults.endless:PhilEndless-v0"
END, BRIGHT, BRAKES = "end", "bright", "brakes"
_FULL_MPS2, _MOST_MPS = 4.0, 12.0
_WHITE, _DARKEST_TO_BRIGHTEST = 255, 120


class EndlessEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A car on a straight road; the picture is noise below half brightness, new every step."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, FRAMES_SHAPE, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.brake_action = np.array([-1.0], np.float32)
        self._directory = Path(os.environ[DIRECTORY])
        self._braking = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Stand at the start of the road."""
        super().reset(seed=seed)
        self._speed_mps = self._distance_m = 0.0
        return self._frames(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period."""
        change_mps = float(action[0]) * _FULL_MPS2 * CONTROL_PERIOD_S
        self._speed_mps = min(max(self._speed_mps + change_mps, 0.0), _MOST_MPS)
        self._distance_m += self._speed_mps * CONTROL_PERIOD_S
        ended = (self._directory / END).exists()
        return self._frames(), 0.0, ended, False, self._info()

    def press_brake(self, pressed: bool) -> None:
        """Told every tick whether the vehicle brakes; only changes are written."""
        if pressed != self._braking:
            self._braking = pressed
            with (self._directory / BRAKES).open("a") as brakes:
                brakes.write(f"{time.monotonic():.6f} {int(pressed)}\n")

    def _frames(self) -> np.ndarray:
        if (self._directory / BRIGHT).exists():
            return np.full(FRAMES_SHAPE, _WHITE, np.uint8)
        return self.np_random.integers(0, _DARKEST_TO_BRIGHTEST, FRAMES_SHAPE, dtype=np.uint8)

    def _info(self) -> dict[str, Any]:
        return {"distance_m": self._distance_m, "speed_mps": self._speed_mps, "outcome": "goal"}


if "PhilEndless-v0" not in gymnasium.registry:
    gymnasium.register(
        "PhilEndless-v0",
        entry_point=f"{__name__}:EndlessEnv",
        disable_env_checker=True,
        order_enforce=False,
    )
