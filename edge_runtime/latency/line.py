"""A line of limited bandwidth with a queue before it that drops when it is full. Pure."""

from __future__ import annotations

from typing import Optional

from edge_runtime.latency.spec import DirectionSpec


class Line:
    """Sends one message after the other; the queue is bounded by the wait that it stands for."""

    def __init__(self, spec: DirectionSpec) -> None:
        self._rate_bytes_per_s = spec.rate_kbps * 1e3 / 8
        self._longest_wait_s = spec.queue_ms * 1e-3
        self._free_s = float("-inf")

    def send(self, now_s: float, size_bytes: int) -> Optional[float]:
        """When the message's last byte has left; None if the queue is full. No rate: at once."""
        if not self._rate_bytes_per_s:
            return now_s
        begin_s = max(now_s, self._free_s)
        if begin_s - now_s > self._longest_wait_s:
            return None
        self._free_s = begin_s + size_bytes / self._rate_bytes_per_s
        return self._free_s
