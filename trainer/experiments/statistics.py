"""Means, intervals and the verdicts that they allow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Numbers = NDArray[np.float64]
Holds = Literal["yes", "no", "undecided"]
CONFIDENCE = 0.95
TAIL = 0.5 * (1.0 - CONFIDENCE)
"""Outside each end of an interval."""


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

    def as_share(self) -> str:
        """A share in percent, whose interval ends at 0 and 100."""
        if self.size < 2:
            return self.times(100.0).text(1)
        held = self._replace(low=max(self.low, 0.0), high=min(self.high, 1.0))
        return held.times(100.0).text(1)

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


def mean_estimate(values: Iterable[float]) -> Estimate:
    """Mean and Student's 95 % interval; no interval for fewer than two values."""
    numbers = np.fromiter(values, float)
    numbers = numbers[~np.isnan(numbers)]
    if len(numbers) == 0:
        return NOTHING
    mean = float(numbers.mean())
    if len(numbers) == 1:
        return Estimate(mean, float("-inf"), float("inf"), 1)
    reach = float(stats.t.ppf(1.0 - TAIL, len(numbers) - 1) * stats.sem(numbers))
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
    if "no" in answers:
        return "no"
    return "yes" if answers and set(answers) == {"yes"} else "undecided"


def bootstrap(values: Sequence[float], point: float, size: int) -> Estimate:
    """A number with the 95 % interval of its resampled values, some of which may be infinite."""
    if size < 2:
        return Estimate(point, float("-inf"), float("inf"), size)
    ends = np.quantile(values, (TAIL, 1.0 - TAIL), method="inverted_cdf")
    return Estimate(point, float(ends[0]), float(ends[1]), size)
