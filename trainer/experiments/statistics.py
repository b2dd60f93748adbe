"""Means, intervals and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from trainer.plots import moving_average

Numbers = NDArray[np.float64]
Holds = Literal["yes", "no", "undecided"]
CONFIDENCE = 0.95
WINDOW = 20
"""Episodes over which curves are smoothed, and final averages taken."""
RESAMPLES = 2000


class Estimate(NamedTuple):
    """A number with its interval; the interval is infinite where there is too little to say."""

    value: float
    low: float
    high: float
    size: int
    """Values behind it."""

    def times(self, factor: float) -> Estimate:
        """The number and its interval multiplied."""
        low, high = sorted((factor * self.low, factor * self.high))
        return Estimate(factor * self.value, low, high, self.size)

    def text(self, digits: int = 2, unit: str = "") -> str:
        """As in "0.97 [0.93, 0.99]"; a dash for nothing."""
        if not self.size:
            return "–"
        shown = f"{self.value:.{digits}f}{unit}"
        if np.isinf([self.low, self.high]).all():
            return shown
        low, high = (f"{end:.{digits}f}".replace("inf", "∞") for end in (self.low, self.high))
        return f"{shown} [{low}, {high}]"


NOTHING = Estimate(float("nan"), float("-inf"), float("inf"), 0)


def mean_estimate(values: Sequence[float] | Numbers) -> Estimate:
    """Mean and Student's 95 % interval; no interval for fewer than two values."""
    numbers = np.asarray(values, dtype=float)
    if len(numbers) == 0:
        return NOTHING
    mean = float(numbers.mean())
    if len(numbers) == 1:
        return Estimate(mean, float("-inf"), float("inf"), 1)
    error = float(numbers.std(ddof=1)) / len(numbers) ** 0.5
    reach = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, len(numbers) - 1)) * error
    return Estimate(mean, mean - reach, mean + reach, len(numbers))


def success_estimate(successes: int, count: int) -> Estimate:
    """Share of successes and Wilson's 95 % interval."""
    if count == 0:
        return NOTHING
    interval = stats.binomtest(successes, count).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high), count)


def above(difference: Estimate, least: float = 0.0) -> Holds:
    """Whether a number is above ``least``: decided where the interval lies on one side."""
    if difference.low > least:
        return "yes"
    return "no" if difference.high < least else "undecided"


def within(difference: Estimate, reach: float) -> Holds:
    """Whether a difference is at most ``reach`` either way."""
    if -reach <= difference.low and difference.high <= reach:
        return "yes"
    return "no" if difference.low > reach or difference.high < -reach else "undecided"


def all_of(answers: Sequence[Holds]) -> Holds:
    """Yes where all are, no where one is not."""
    if "no" in answers or not answers:
        return "no" if answers else "undecided"
    return "yes" if set(answers) == {"yes"} else "undecided"


class Judged(NamedTuple):
    """Whether all of some differences are above a number."""

    holds: Holds
    size: int
    """Values behind the one that decides, or the fewest behind any where all count."""
    decisive: Estimate | None
    """The one that says no; of those that leave it open the lowest; the lowest end of those that
    say yes."""
    rival: str
    """Its name; empty where none decides."""


def judge_all(differences: Mapping[str, Estimate], sign: float = 1.0, least: float = 0.0) -> Judged:
    """Judge whether all differences, or with sign -1 their opposites, are above ``least``."""
    signed = {name: each.times(sign) for name, each in differences.items()}
    holds = all_of([above(each, least) for each in signed.values()])
    if holds == "no":
        rival = min(signed, key=lambda name: signed[name].high)
        return Judged(holds, signed[rival].size, differences[rival], rival)
    size = min((each.size for each in signed.values()), default=0)
    candidates = {
        name: each.low if holds == "yes" else each.value
        for name, each in signed.items()
        if each.size and above(each, least) == holds
    }
    if not candidates:
        return Judged(holds, size, None, "")
    rival = min(candidates, key=candidates.__getitem__)
    return Judged(holds, size, differences[rival], rival)


def paired_t(first: Numbers, second: Numbers) -> float:
    """P value of the paired t-test (two-sided); 1 where the pairs do not differ or are too few."""
    difference = np.asarray(first, dtype=float) - np.asarray(second, dtype=float)
    if len(difference) < 2 or np.all(difference == 0.0):
        return 1.0
    if np.all(difference == difference[0]):
        return 0.0  # scipy divides by a spread of zero
    return float(stats.ttest_rel(first, second).pvalue)


def stars(p_value: float) -> str:
    """The usual marks of significance."""
    marks = ((0.001, "***"), (0.01, "**"), (0.05, "*"))
    return next((mark for limit, mark in marks if p_value < limit), "n.s.")


def smoothed(curves: Numbers) -> Numbers:
    """Curves of several seeds, float [seeds, episodes], each as a moving average."""
    return np.stack([moving_average(curve, WINDOW) for curve in curves])
