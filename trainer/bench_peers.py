"""The bench's peers, at the same work as ours: Stable-Baselines3's TD3, highway-env's picture."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium
import numpy as np
import torch
from highway_env.envs.common.observation import GrayscaleObservation
from numpy.typing import NDArray
from torch import nn

from trainer.export import real_observations
from trainer.learner.replay import ReplayBuffer
from trainer.scenarios import SCENARIOS
from trainer.scenarios.picture import COLUMNS, ROWS

HUMAN_SHARE = 0.2
"""About what a guided run's buffer holds; the Q advantage is computed for these only."""
FEATURES = 1792
GREY_WEIGHTS = [0.2989, 0.5870, 0.1140]
"""Red, green and blue in the grey value, as in highway-env's documentation."""


class Experience(NamedTuple):
    """``n`` transitions of one long drive: real observations, invented rewards."""

    frames: NDArray[np.uint8]
    """[n + 1, 2, 45, 80]."""
    actions: NDArray[np.float32]
    """[n, 1]."""
    rewards: NDArray[np.float32]
    """[n]."""
    human: NDArray[np.bool_]
    """[n]."""


def gather(count: int, seed: int = 0) -> Experience:
    """Drive the left turn at random for ``count`` steps."""
    random = np.random.default_rng(seed)
    return Experience(
        frames=real_observations("left_turn", count + 1, seed),
        actions=random.uniform(-1, 1, (count, 1)).astype(np.float32),
        rewards=random.normal(size=count).astype(np.float32),
        human=random.random(count) < HUMAN_SHARE,
    )


def filled(experience: Experience) -> ReplayBuffer:
    """A buffer of ours that holds all of it."""
    replay = ReplayBuffer(len(experience.actions))
    replay.start_episode(experience.frames[0])
    for action, reward, frames, human in zip(
        experience.actions, experience.rewards, experience.frames[1:], experience.human, strict=True
    ):
        replay.add(action, float(reward), frames, False, bool(human))
    return replay


def make_sb3_model(experience: Experience) -> Any:
    """Stable-Baselines3's TD3 with the networks of tables A2 and A3, its replay filled.

    It does less than the paper asks for: both critics share one features extractor, so two
    convolutional networks work in each pass where the paper's critics have two of their own beside
    the actor's; the replay is uniform; there is no Q advantage and no behaviour cloning.

    Raises:
        ImportError: it is not installed.
    """
    from stable_baselines3 import TD3
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Trunk(BaseFeaturesExtractor):
        """The paper's two convolutions; the library normalises the pictures before."""

        def __init__(self, space: gymnasium.Space[Any]) -> None:
            super().__init__(space, FEATURES)
            first, second = nn.Conv2d(2, 6, 6), nn.Conv2d(6, 16, 6)
            pooled = [first, nn.ReLU(), nn.MaxPool2d(2), second, nn.ReLU(), nn.MaxPool2d(2)]
            self.layers = nn.Sequential(*pooled, nn.Flatten())

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            """Features [batch, 1792] of float images [batch, 2, 45, 80] in [0, 1]."""
            features: torch.Tensor = self.layers(images)
            return features

    count = len(experience.actions)
    model = TD3(
        "CnnPolicy",
        gymnasium.make(SCENARIOS["left_turn"]),
        learning_rate=2e-4,
        gamma=0.95,
        tau=1e-3,
        buffer_size=count,
        policy_delay=1,
        policy_kwargs={"features_extractor_class": Trunk, "net_arch": [256, 128, 64]},
        device="cpu",
        seed=0,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    assert model.replay_buffer is not None
    for i in range(count):
        before, after = experience.frames[i, None], experience.frames[i + 1, None]
        action, reward = experience.actions[i, None], experience.rewards[i, None]
        model.replay_buffer.add(before, after, action, reward, np.zeros(1), [{}])
    return model


class HighwayPicture:
    """A scenario of ours whose frames highway-env's GrayscaleObservation draws.

    All else is the scenario's: road, cars and their motion, reward, size and number of the frames,
    the ground in view. highway-env draws each frame (by pygame, then RGB to grey), our rasteriser
    nothing. Left out, in its favour: its own traffic step, and a new viewer at each reset.

    Args:
        env: the scenario's environment, without wrappers; it must not be used elsewhere.
    """

    action_type = observation_type = None
    """As much of a highway-env environment as its viewer looks at, with ``config`` and ``road``."""

    def __init__(self, env: Any) -> None:
        self.env = env
        env._frame = lambda ego, cars: 0
        self.config = {
            "scaling": 1.0 / env.rasteriser.metres_per_pixel,
            "centering_position": [0.5, 0.5],
            "render_agent": True,
            "simulation_frequency": 10,
            # Into a surface in memory, and nothing copied to a screen.
            "offscreen_rendering": True,
        }
        env.reset(seed=0)
        # SDL's "dummy" driver exists on every machine and needs no screen; but highway-env's
        # viewer takes it for a wish not to draw at all.
        with patch.dict(os.environ, {"SDL_VIDEODRIVER": "dummy"}):
            self._drawn = GrayscaleObservation(
                self, observation_shape=(COLUMNS, ROWS), stack_size=2, weights=GREY_WEIGHTS
            )
        self._drawn.viewer.enabled = True

    def reset(self, *, seed: int) -> NDArray[np.uint8]:
        """Start an episode: the observation, uint8 [2, 80, 45] (highway-env has columns first)."""
        self.env.reset(seed=seed)
        self._drawn.obs[:] = self.observe()[-1]
        return self._drawn.obs.copy()

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.uint8], bool]:
        """One control interval: the observation, and whether the episode ended."""
        _, _, terminated, truncated, _ = self.env.step(action)
        return self.observe(), terminated or truncated

    def observe(self) -> NDArray[np.uint8]:
        """Draw what our rasteriser looks at."""
        view = self.env.rasteriser
        middle_m = 0.5 * view.metres_per_pixel * np.array([COLUMNS, ROWS])
        position = np.array(self.env.view_corner_m) + middle_m
        self._drawn.observer_vehicle = SimpleNamespace(position=position)
        observation: NDArray[np.uint8] = self._drawn.observe()
        return observation

    @property
    def road(self) -> Any:
        """Our road, with the ego car among the others: ours stands outside ``road.vehicles``."""
        return SimpleNamespace(
            network=self.env.road.network,
            vehicles=[*self.env.traffic, self.env.ego],
            objects=[],
            record_history=False,
        )


def check_varies(picture: HighwayPicture) -> None:
    """Drive one episode and look at every observation.

    Raises:
        RuntimeError: they are all alike. A viewer of highway-env 1.12 that is not enabled draws
            nothing, without a warning, and would look fast.
    """
    first, ended = picture.reset(seed=0), False
    moves = False
    while not ended:
        observation, ended = picture.step(np.zeros(picture.env.action_space.shape, np.float32))
        moves = moves or not np.array_equal(observation[-1], first[-1])
    if not (moves and first.min() < first.max()):
        raise RuntimeError("highway-env draws the same picture all over: the figures are void")
