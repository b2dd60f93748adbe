"""highway-env's own picture of our traffic: the peer of our rasteriser."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from highway_env.envs.common.observation import GrayscaleObservation
from numpy.typing import NDArray

from trainer.scenarios.picture import COLUMNS, ROWS

WEIGHTS = [0.2989, 0.5870, 0.1140]
"""Red, green and blue in the grey value, as in highway-env's documentation."""


class HighwayPicture:
    """A scenario of ours whose frames highway-env's GrayscaleObservation draws.

    The same as in the scenario: the road network, the cars and their motion, the ego car, reward,
    end of the episode, size of the frames, the stack of two, and the part of the ground in view.
    Different: each frame is drawn by highway-env (lanes, markings and cars by pygame, then RGB to
    grey), and our rasteriser draws nothing. What a real highway-env environment pays on top is left
    out, in its favour: its own traffic step with the search for neighbours, and a new viewer at
    each reset.

    Args:
        env: the scenario's environment, without wrappers; it must not be used elsewhere.
    """

    def __init__(self, env: Any) -> None:
        self.env = env
        env._frame = lambda ego, cars: 0
        self.scene = _Scene(env)
        self.reset(seed=0)

    def reset(self, *, seed: int) -> NDArray[np.uint8]:
        """Start an episode: the observation, uint8 [2, 80, 45] (highway-env has columns first)."""
        self.env.reset(seed=seed)
        self.observation = self.scene.observation()
        self.observation.obs[:] = self.observation.observe()[-1]
        return self.observation.obs.copy()

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.uint8], bool]:
        """One control interval: the observation, and whether the episode ended."""
        _, _, terminated, truncated, _ = self.env.step(action)
        return self.scene.observation().observe(), terminated or truncated


class _Scene:
    """As much of a highway-env environment as its viewer looks at."""

    action_type = observation_type = None

    def __init__(self, env: Any) -> None:
        self._env = env
        self.config = {
            "scaling": 1.0 / env.rasteriser.metres_per_pixel,
            "centering_position": [0.5, 0.5],
            "render_agent": True,
            "simulation_frequency": 10,
            # Into a surface in memory, and nothing copied to a screen.
            "offscreen_rendering": True,
        }
        # SDL's "dummy" driver exists on every machine and needs no screen; but highway-env's
        # viewer takes it for a wish not to draw at all.
        with patch.dict(os.environ, {"SDL_VIDEODRIVER": "dummy"}):
            self._observation = GrayscaleObservation(
                self, observation_shape=(COLUMNS, ROWS), stack_size=2, weights=WEIGHTS
            )
        self._observation.viewer.enabled = True

    def observation(self) -> Any:
        """The observation, looking at what our rasteriser looks at."""
        view = self._env.rasteriser
        middle_m = 0.5 * view.metres_per_pixel * np.array([COLUMNS, ROWS])
        position = np.array(self._env.view_corner_m) + middle_m
        self._observation.observer_vehicle = SimpleNamespace(position=position)
        return self._observation

    @property
    def road(self) -> Any:
        """Our road, with the ego car among the others: ours stands outside ``road.vehicles``."""
        road = self._env.road
        return SimpleNamespace(
            network=road.network,
            vehicles=[*self._env.traffic, self._env.ego],
            objects=[],
            record_history=False,
        )


def check_varies(env: HighwayPicture, seed: int = 0) -> None:
    """Drive one episode and look at every observation.

    Raises:
        RuntimeError: they are all alike. A viewer of highway-env 1.12 that is not enabled draws
            nothing, without a warning, and would look fast.
    """
    first, ended = env.reset(seed=seed), False
    varies = first.min() < first.max()
    moves = False
    while not ended:
        observation, ended = env.step(np.zeros(env.env.action_space.shape, np.float32))
        moves = moves or not np.array_equal(observation[-1], first[-1])
    if not (varies and moves):
        raise RuntimeError("highway-env draws the same picture all over: the figures are void")
