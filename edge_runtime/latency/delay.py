"""How long a message is under way: shapes with mean 0 and standard deviation 1. Pure.

The delay is ``delay + jitter * shape``, so rows with the same delay and jitter compare whatever
their tail; netem's distribution tables are used the same way. All shapes are increasing functions
of one standard normal draw: the same seed delays the same messages, and only how far differs.

A long-tailed link has a floor (propagation) little below its mean and rare, very late messages:
at least ``delay - 0.76 jitter`` with ``lognormal`` and ``delay - 0.58 jitter`` with ``pareto``.
"""

from __future__ import annotations

import math
from typing import Callable, Dict

LOGNORMAL_SIGMA = 1.0
PARETO_ALPHA = 3.0
"""As netem's pareto table. Variance is finite above 2; the third moment is not at 3."""

_LOGNORMAL_MEAN = math.exp(LOGNORMAL_SIGMA**2 / 2)
_LOGNORMAL_STD = _LOGNORMAL_MEAN * math.sqrt(math.expm1(LOGNORMAL_SIGMA**2))
_PARETO_MEAN = PARETO_ALPHA / (PARETO_ALPHA - 1)
_PARETO_STD = _PARETO_MEAN / math.sqrt(PARETO_ALPHA * (PARETO_ALPHA - 2))


def _normal(draw: float) -> float:
    return draw


def _lognormal(draw: float) -> float:
    return (math.exp(LOGNORMAL_SIGMA * draw) - _LOGNORMAL_MEAN) / _LOGNORMAL_STD


def _pareto(draw: float) -> float:
    upper_tail = 0.5 * math.erfc(draw / math.sqrt(2.0))
    return (upper_tail ** (-1.0 / PARETO_ALPHA) - _PARETO_MEAN) / _PARETO_STD


SHAPES: Dict[str, Callable[[float], float]] = {
    "normal": _normal,
    "lognormal": _lognormal,
    "pareto": _pareto,
}
