"""Whole updates of our learner, one timed after the other."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from trainer.learner.replay import Batch, ReplayBuffer
from trainer.learner.td3 import Losses


class Learner(Protocol):
    """What can be timed."""

    def update(self, batch: Batch, beta: float) -> Losses:
        """One step of algorithm 1."""
        ...


class Updates:
    """A learner and a buffer that holds something.

    Args:
        learner: to be timed.
        replay: what it learns from.
        batch_size: transitions in a minibatch.
        seed: of the drawing.
    """

    def __init__(
        self, learner: Learner, replay: ReplayBuffer, batch_size: int, seed: int = 0
    ) -> None:
        self.learner, self.replay, self.batch_size = learner, replay, batch_size
        self.random = np.random.default_rng(seed)

    def run(self, count: int) -> list[float]:
        """Milliseconds of each of ``count`` updates: drawing, update, new priorities."""
        times_ms = []
        for _ in range(count):
            began_s = time.perf_counter()
            batch = self.replay.sample(self.batch_size, self.random)
            losses = self.learner.update(batch, 0.0)
            self.replay.update_priorities(batch.indices, losses.priorities)
            times_ms.append(1e3 * (time.perf_counter() - began_s))
        return times_ms
