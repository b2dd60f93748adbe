"""Quantiles of the last measurements. Old ones leave, so that one bad start is not for ever."""

from __future__ import annotations

from collections import deque
from typing import Deque, Dict

import numpy as np

WINDOW = 1024


class LatencyWindow:
    """The last WINDOW durations. Not thread-safe: the caller holds a lock."""

    def __init__(self) -> None:
        self._durations_ns: Deque[int] = deque(maxlen=WINDOW)

    def add(self, duration_ns: int) -> None:
        """Take one measurement, in nanoseconds."""
        self._durations_ns.append(duration_ns)

    def summary_ms(self) -> Dict[str, float]:
        """p50, p99 and max in milliseconds; zeros before the first measurement."""
        if not self._durations_ns:
            return {"p50": 0.0, "p99": 0.0, "max": 0.0}
        p50, p99, top = np.percentile(np.array(self._durations_ns) / 1e6, [50, 99, 100])
        return {"p50": float(p50), "p99": float(p99), "max": float(top)}
