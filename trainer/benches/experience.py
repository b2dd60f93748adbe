"""Real observations with invented rewards: what every learner of the bench learns from."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainer.export import real_observations
from trainer.learner.replay import ReplayBuffer

HUMAN_SHARE = 0.2
"""About what a guided run's buffer holds; the Q advantage is computed for these only."""


class Experience(NamedTuple):
    """``n`` transitions of one long drive."""

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


def fill(replay: ReplayBuffer, experience: Experience) -> None:
    """Put all of it into our buffer."""
    replay.start_episode(experience.frames[0])
    steps: Any = zip(
        experience.actions, experience.rewards, experience.frames[1:], experience.human, strict=True
    )
    for action, reward, frames, human in steps:
        replay.add(action, float(reward), frames, False, bool(human))


def save(experience: Experience, path: Path) -> None:
    """Write it for a peer in another process (numpy's ``.npz``)."""
    np.savez(path, **experience._asdict())
