"""Learning efficiency: how much sooner one learner gets where another one ends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainer.experiments.outcome import Numbers
from trainer.experiments.progress import Progress
from trainer.experiments.statistics import CONFIDENCE, RESAMPLES, Estimate

TAIL = 0.5 * (1.0 - CONFIDENCE)
"""Outside each end of an interval."""


class Efficiency(NamedTuple):
    """How much sooner a learner gets where the baseline ends."""

    ratio: Estimate
    """The baseline's episodes over the learner's; 95 % bootstrap interval over the seeds, with
    what lies between two measurements."""
    episodes: float
    baseline_episodes: float


class Reached(NamedTuple):
    """When a level was reached: after the episode ``before``, where it was not yet, and not later
    than after ``at``, where it was measured. Who is there at the first value that counts may have
    been there all the time (0); who never is, may be after the last one (infinite).
    """

    before: float
    at: float


def efficiency(ours: Progress, baseline: Progress, common: bool = False) -> Efficiency:
    """Compare two learners by the episodes that the means of their seeds need.

    The level is the baseline's final average, or the lower of both where it is to be a ``common``
    one. A learner that never gets there has the ratio 0. The bootstrap draws whole seeds, of both
    independently, 2000 times; with few seeds it understates the spread. Validations are ten
    episodes apart, so the interval is from the least ratio that the measurements allow to the
    largest.
    """
    own, other = _needed(ours, baseline, common)
    count = min(len(ours.curves), len(baseline.curves))
    low, high = float("-inf"), float("inf")
    if count > 1:
        random = np.random.default_rng(0)
        least, most = [], []
        for _ in range(RESAMPLES):
            first, second = _needed(_drawn(ours, random), _drawn(baseline, random), common)
            least.append(_ratio(first.at, second.before))
            most.append(_ratio(first.before, second.at))
        # Ratios as they are, nothing between two of them: some are infinite.
        low, high = (
            float(np.quantile(ratios, share, method="inverted_cdf"))
            for ratios, share in ((least, TAIL), (most, 1.0 - TAIL))
        )
    value = _ratio(own.at, other.at)
    return Efficiency(Estimate(value, low, high, count), own.at, other.at)


def episodes_to_reach(learner: Progress, curve: Numbers, level: float) -> Reached:
    """Episodes until a curve of the learner first reaches a level."""
    episodes, values = learner.episodes[learner.whole], curve[learner.whole]
    first = np.flatnonzero(values >= level - 1e-9)
    place = int(first[0]) if len(first) else len(values)
    before = float(episodes[place - 1]) if place else 0.0
    return Reached(before, float(episodes[place]) if len(first) else float("inf"))


def _needed(ours: Progress, baseline: Progress, common: bool) -> tuple[Reached, Reached]:
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
    if np.isinf(episodes):
        return 0.0
    return baseline_episodes / episodes if episodes else float("inf")
