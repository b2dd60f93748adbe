"""Estimates with 95 % confidence intervals, for reports, experiments and sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
TAIL = 0.5 * (1.0 - CONFIDENCE)  # Outside each end of an interval


class Estimate(NamedTuple):
    """A number with its interval; the interval is infinite where there are too few values."""

    value: float
    low: float
    high: float
    size: int  # Values behind it

    def times(self, factor: float) -> Estimate:
        """Multiply the number and its interval."""
        low, high = sorted((factor * self.low, factor * self.high))
        return Estimate(factor * self.value, low, high, self.size)

    def as_share(self) -> str:
        """Return a share in percent, with the interval cut off at 0 and 100."""
        if self.size < 2:
            return self.times(100.0).text(1)
        held = self._replace(low=max(self.low, 0.0), high=min(self.high, 1.0))
        return held.times(100.0).text(1)

    def text(self, digits: int = 2) -> str:
        """Return "0.97 [0.93, 0.99]"; a dash for no values, the interval alone for NaN."""
        bounded = np.isfinite([self.low, self.high]).any()
        if not self.size or (np.isnan(self.value) and not bounded):
            return "–"
        shown, low, high = (f"{number:.{digits}f}" for number in self[:3])
        if not bounded:
            return shown
        return f"{shown} [{low}, {high}]".replace("nan ", "").replace("inf", "∞")


NOTHING = Estimate(float("nan"), float("-inf"), float("inf"), 0)


def mean_estimate(values: Iterable[float]) -> Estimate:
    """Return the mean of the values that are not NaN, with Student's interval."""
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
    """Return the share of successes with Wilson's interval."""
    if count == 0:
        return NOTHING
    interval = stats.binomtest(successes, count).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high), count)


def bootstrap(values: Sequence[float], point: float, size: int) -> Estimate:
    """Return ``point`` with the interval of its resampled values, which may be infinite."""
    if size < 2:
        return Estimate(point, float("-inf"), float("inf"), size)
    ends = np.quantile(values, (TAIL, 1.0 - TAIL), method="inverted_cdf")
    return Estimate(point, float(ends[0]), float(ends[1]), size)
