"""No faster than a rate: a token bucket. Pure, time is passed in."""

from __future__ import annotations

BURST = 2.0
"""So that jitter of a stream at just this rate costs no message."""


class RateBound:
    """Lets ``rate_hz`` messages a second through on average, and two at once at most."""

    def __init__(self, rate_hz: float) -> None:
        self.skipped = 0
        self._rate_hz = rate_hz
        self._tokens = BURST
        self._filled_s: float | None = None

    def lets(self, now_s: float) -> bool:
        """Return whether a message may pass now; one that may not is counted."""
        elapsed_s = 0.0 if self._filled_s is None else max(0.0, now_s - self._filled_s)
        self._filled_s = now_s
        self._tokens = min(BURST, self._tokens + elapsed_s * self._rate_hz)
        if self._tokens < 1.0:
            self.skipped += 1
            return False
        self._tokens -= 1.0
        return True
