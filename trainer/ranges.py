"""Checks of settings: every number of a config has a range, and a wrong one gets one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from edge_runtime.util import UserError

Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)
FROM_ONE: Range = (1, math.inf)
FROM_ZERO: Range = (0, math.inf)
ABOVE_ZERO: Range = (2.0**-126, math.inf)
"""From float32's smallest normal number on: what is less may become zero on its way."""
SHARE: Range = (0, 1)


def check_ranges(config: Any, ranges: Mapping[str, Range]) -> None:
    """Raise UserError unless every named field of ``config`` is finite and within its range."""
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not (math.isfinite(value) and low <= value <= high):
            raise UserError(f"{name} = {value} is out of range: {_text(low, high)}")


def _text(low: float, high: float) -> str:
    if math.isinf(low):
        return "it must be a finite number"
    if (low, high) == ABOVE_ZERO:
        return "it must be above 0"
    return f"at least {low}" if math.isinf(high) else f"{low} to {high}"
