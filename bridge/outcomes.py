"""Outcomes of episodes, and estimates with 95 % confidence intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

GOAL, FAILED, COLLISION = "goal", "failed", "collision"
UNKNOWN = "ended"  # The environment reports neither ``outcome`` nor ``is_success``
TRUNCATED = "truncated"  # Gymnasium's step limit ended an episode of UNKNOWN outcome
TIMEOUT = "timeout"  # The same, in an environment that reports other outcomes (`settled`)
STOPPED, RESTARTED = "stopped", "restarted"  # The person ended the episode
DISCARDED = "discarded"  # The person discarded the episode: it is shown but not learned from
UNTOLD = {UNKNOWN, TRUNCATED, STOPPED, RESTARTED, DISCARDED}
"""Outcomes that say nothing about success."""


def failed(outcome: str) -> bool:
    return outcome != GOAL and outcome not in UNTOLD


def outcome_of(info: Mapping[str, Any], only_truncated: bool = False) -> str:
    """Return the outcome that the last step's ``info`` reports.

    Without a report: TRUNCATED where only a step limit ended the episode, else UNKNOWN.
    """
    if info.get("outcome"):
        return str(info["outcome"])
    success = info.get("is_success")
    if success is None:
        return TRUNCATED if only_truncated else UNKNOWN
    return GOAL if success else FAILED


def is_told(outcomes: Iterable[str]) -> bool:
    return not UNTOLD.issuperset(outcomes)


def success_share(outcomes: Iterable[str]) -> float:
    """Return the share of GOAL; nan if no outcome says whether its episode succeeded."""
    outcomes = list(outcomes)
    return outcomes.count(GOAL) / len(outcomes) if is_told(outcomes) else np.nan


def settled(outcomes: Iterable[str]) -> list[str]:
    """Return the outcomes, with TIMEOUT for TRUNCATED if any episode reports how it ended."""
    outcomes = list(outcomes)
    is_reported = is_told(outcomes)
    return [TIMEOUT if is_reported and each == TRUNCATED else each for each in outcomes]


UPPER = 0.975  # Quantile at the upper end of a 95 % interval


class Estimate(NamedTuple):
    """A number with its interval, which is infinite for less than two values."""

    value: float
    low: float
    high: float
    size: int  # Values behind it

    def times(self, factor: float) -> Estimate:
        return Estimate(factor * self.value, factor * self.low, factor * self.high, self.size)

    def as_share(self) -> str:
        """Return a share in percent, with the interval cut off at 0 and 100."""
        low, high = max(self.low, 0.0), min(self.high, 1.0)
        shown = self if self.size < 2 else self._replace(low=low, high=high)
        return shown.times(100.0).text(1)

    def text(self, digits: int = 2) -> str:
        """Return "0.97 [0.93, 0.99]"; without an interval the value; without values a dash."""
        if not self.size:
            return "–"
        value, low, high = (f"{number:.{digits}f}" for number in self[:3])
        return f"{value} [{low}, {high}]" if np.isfinite(self.low) else value


def mean_estimate(values: Iterable[float]) -> Estimate:
    """Return the mean of the values that are not NaN, with Student's interval."""
    numbers = np.fromiter(values, float)
    numbers = numbers[~np.isnan(numbers)]
    count, mean = len(numbers), float(numbers.mean()) if len(numbers) else np.nan
    if count < 2:
        return Estimate(mean, -np.inf, np.inf, count)
    from scipy.special import stdtrit  # Slow to load; scipy.stats takes a second

    reach = float(stdtrit(count - 1, UPPER) * numbers.std(ddof=1) / np.sqrt(count))
    return Estimate(mean, mean - reach, mean + reach, count)


def success_estimate(successes: int, count: int) -> Estimate:
    z2, failures = NormalDist().inv_cdf(UPPER) ** 2, count - successes
    reach = (z2 * (successes * failures / count + z2 / 4)) ** 0.5  # Wilson's interval
    low, high = ((part + z2 / 2 - reach) / (count + z2) for part in (successes, failures))
    return Estimate(successes / count, low, 1.0 - high, count)
