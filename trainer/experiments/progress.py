"""How training went: curves over the episodes, with the human's help and without it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainer.experiments.outcome import Episodes, Numbers, Outcome, within_path
from trainer.experiments.statistics import WINDOW, smoothed

METRICS = {
    "episode_return": "reward in training",
    "distance_m": "surviving distance in training, m",
}
"""What the paper's learning curves show: episodes in which the human may take over, so that whoever
is guided looks good from the first one on."""
ALONE = "validation_success"
"""The policy alone, now and then. Its success: a mean of distances, cut at the goal, would hide a
few failures behind what the other drives cover beyond it."""
TITLES = {**METRICS, ALONE: "success without help"}
"""What ours show."""
DISTANCE_ALONE = "validation_distance_m"
"""For shares and for levels that both of two are to reach: who learns nothing has no success, of
which a share says nothing, and drives some metres."""
DISTANCES = ("distance_m", DISTANCE_ALONE)
VALIDATED = (ALONE, DISTANCE_ALONE)
NAMED = {**TITLES, DISTANCE_ALONE: "surviving distance without help, m"}
"""Whatever a claim may be about."""


class Progress(NamedTuple):
    """One metric of an algorithm's seeds."""

    episodes: Episodes
    """Where there is a value, counted from 1: [n]."""
    curves: Numbers
    """Moving averages, or what was measured now and then: [seeds, n]."""
    whole: NDArray[np.bool_]
    """Which values count as reached, [n]: before, an average is one of too few episodes, and one
    lucky episode would do."""
    ends: Numbers
    """Final average of each seed, [seeds]."""


def progress(outcomes: Sequence[Outcome], metric: str) -> Progress | None:
    """The progress of some seeds; None without any."""
    if not outcomes:
        return None
    ends = np.array([final(outcome, metric) for outcome in outcomes])
    measured = [_measured(outcome, metric) for outcome in outcomes]
    shared = reduce(np.intersect1d, [episodes for episodes, _ in measured])
    curves = np.stack([values[np.isin(episodes, shared)] for episodes, values in measured])
    if metric in VALIDATED:
        return Progress(shared, curves, np.ones(len(shared), dtype=bool), ends)
    return Progress(shared, smoothed(curves), shared >= min(WINDOW, len(shared)), ends)


def final(outcome: Outcome, metric: str) -> float:
    """Mean of what was measured in the last ``WINDOW`` episodes."""
    episodes, values = _measured(outcome, metric)
    return float(values[episodes > episodes[-1] - WINDOW].mean())


def _measured(outcome: Outcome, metric: str) -> tuple[Episodes, Numbers]:
    """What was measured; no distance beyond the goal, or two who always arrive would be told apart
    by how fast they cross its line. A validation's distance is a mean, and cut as one.
    """
    episodes, values = outcome.measured(metric)
    if metric in DISTANCES:
        values = within_path(outcome.unit.scenario, values)
    return episodes, values
