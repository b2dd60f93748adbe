"""Whole training: where its time goes, and how much more it takes than its updates alone."""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trainer.benches.effort import Effort
from trainer.benches.turns import Tick
from trainer.benches.updates import Updates
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import TD3Learner
from trainer.training.config import RunConfig
from trainer.training.learning import LearningThread
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun

PARTS = ("environment", "acting", "storing", "learning", "waiting")
ENDLESS = 10**6
"""Episodes; the bench stops after those it wants, so that no checkpoint is written."""


class Episode(NamedTuple):
    """One training episode with an update in every step."""

    steps: int
    whole_s: float
    """By the clock on the wall: with metrics and all that no part counts."""
    parts_s: dict[str, float]
    own_ms: float
    """An update of the learner alone, mean of before and after the episode."""

    @property
    def ratio(self) -> float:
        """The whole over the learner's own time for as many updates."""
        return self.whole_s / (1e-3 * self.own_ms * self.steps)


class _EnoughError(Exception):
    """Ends the training."""


class _Watch:
    """Looks at a run between its episodes.

    The learner alone is another learner on the run's own buffer: its minibatches have the same
    share of the human's samples, which cost more, and the run's weights stay as they are. It works
    in the thread of the run's updates: a second pool of OpenMP threads would slow both down.
    """

    def __init__(self, run: TrainingRun, effort: Effort, tick: Tick) -> None:
        config = run.config.learner
        alone = TD3Learner(config, run.algorithm, run.config.seed)
        assert isinstance(run.learning, LearningThread)
        self.learning = run.learning
        self.updates = Updates(alone, run.learning.replay, config.batch_size)
        self.warmup_steps = config.warmup_steps
        self.effort, self.tick = effort, tick
        self.episodes: list[Episode] = []
        self._own_ms = float("nan")
        self._began_s = time.perf_counter()

    def __call__(self, metrics: EpisodeMetrics) -> None:
        """After each episode."""
        whole_s = time.perf_counter() - self._began_s
        before_ms = self._own_ms
        if metrics.total_steps >= self.warmup_steps:
            times_ms = self.learning.in_thread(self.updates.run, self.effort.own_updates)
            self._own_ms = float(np.median(times_ms))
        if metrics.total_steps - metrics.steps >= self.warmup_steps:
            parts_s = {name: getattr(metrics, f"{name}_s") for name in PARTS}
            own_ms = 0.5 * (before_ms + self._own_ms)
            self.episodes.append(Episode(metrics.steps, whole_s, parts_s, own_ms))
            self.tick("training")
            if len(self.episodes) == self.effort.training_episodes:
                raise _EnoughError
        self._began_s = time.perf_counter()


def measure_training(effort: Effort, tick: Tick) -> dict[str, Any]:
    """PHIL-TD3 in the left turn, without validation and checkpoints."""
    config = RunConfig(
        episodes=ENDLESS,
        evaluate_every_steps=0,
        checkpoint_every=ENDLESS + 1,
        learner=LearnerConfig(batch_size=effort.batch_size, warmup_steps=effort.batch_size),
    )
    with tempfile.TemporaryDirectory() as directory:
        run = TrainingRun(config, Path(directory))
        watch = _Watch(run, effort, tick)
        with contextlib.suppress(_EnoughError):
            run.train(watch)
    return summary(watch.episodes)


def summary(episodes: list[Episode]) -> dict[str, Any]:
    """Seconds for 10,000 steps, scaled up, and the ratio to the learner alone."""
    steps = sum(episode.steps for episode in episodes)
    alone_s = sum(1e-3 * episode.own_ms * episode.steps for episode in episodes)
    whole_s = sum(episode.whole_s for episode in episodes)
    scaled = {
        name: 1e4 / steps * sum(episode.parts_s[name] for episode in episodes) for name in PARTS
    }
    return {
        "episodes": len(episodes),
        "steps": steps,
        "s_per_10k_steps": {"total": 1e4 / steps * whole_s, **scaled},
        "learner_alone_s_per_10k_updates": 1e4 / steps * alone_s,
        "ratio_to_learner_alone": {
            "of_sums": whole_s / alone_s,
            "median_of_episodes": float(np.median([episode.ratio for episode in episodes])),
        },
    }
