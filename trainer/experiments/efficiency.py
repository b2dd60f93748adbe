"""Learning efficiency: how much sooner one learner gets where another one ends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainer.experiments.outcome import Numbers
from trainer.experiments.progress import Progress
from trainer.experiments.statistics import CONFIDENCE, RESAMPLES, Estimate


class Efficiency(NamedTuple):
    """How much sooner a learner gets where the baseline ends."""

    ratio: Estimate
    """The baseline's episodes over the learner's; 95 % bootstrap interval over the seeds."""
    episodes: float
    baseline_episodes: float


def efficiency(ours: Progress, baseline: Progress, common: bool = False) -> Efficiency:
    """Compare two learners by the episodes that the means of their seeds need.

    The level is the baseline's final average, or the lower of both where it is to be a ``common``
    one. A learner that never gets there has the ratio 0. The bootstrap draws whole seeds, of both
    independently, 2000 times; with few seeds it understates the spread.
    """
    episodes, baseline_episodes = _needed(ours, baseline, common)
    count = min(len(ours.curves), len(baseline.curves))
    low, high = float("-inf"), float("inf")
    if count > 1:
        random = np.random.default_rng(0)
        ratios = []
        for _ in range(RESAMPLES):
            first, second = _needed(_drawn(ours, random), _drawn(baseline, random), common)
            ratios.append(_ratio(first, second))
        tail = 0.5 * (1.0 - CONFIDENCE)
        low, high = (float(x) for x in np.quantile(ratios, (tail, 1.0 - tail)))
    value = _ratio(episodes, baseline_episodes)
    return Efficiency(Estimate(value, low, high, count), episodes, baseline_episodes)


def episodes_to_reach(learner: Progress, curve: Numbers, level: float) -> float:
    """Episodes until a curve of the learner first reaches a level; infinite if it never does."""
    reached = learner.episodes[learner.whole & (curve >= level - 1e-9)]
    return float(reached[0]) if len(reached) else float("inf")


def _needed(ours: Progress, baseline: Progress, common: bool) -> tuple[float, float]:
    level = float(baseline.ends.mean())
    if common:
        level = min(level, float(ours.ends.mean()))
    first, second = (
        episodes_to_reach(one, one.curves.mean(axis=0), level) for one in (ours, baseline)
    )
    return first, second


def _drawn(learner: Progress, random: np.random.Generator) -> Progress:
    """As many seeds, drawn with replacement."""
    seeds = random.integers(len(learner.curves), size=len(learner.curves))
    return learner._replace(curves=learner.curves[seeds], ends=learner.ends[seeds])


def _ratio(episodes: float, baseline_episodes: float) -> float:
    return 0.0 if np.isinf(episodes) else baseline_episodes / episodes
