"""Pictures no more often than they are looked at. Pure: time is passed in."""

from __future__ import annotations

PICTURE_INTERVAL_S = 0.1
"""Ten a second are as many as a control period makes, and plenty for an eye."""


class Pace:
    """Says when the next one is due, so that in the long run no more than one an interval is.

    An interval of 0 s takes all.

    One that comes up to half an interval early is taken: what is sent every 0.1 s arrives with
    some jitter, and waiting for the next would lose every second one.
    """

    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
        self._next_s: float | None = None

    def due(self, now_s: float) -> bool:
        """Whether one may come now; if so, it is counted."""
        if not self.interval_s:
            return True
        half_s = 0.5 * self.interval_s
        if self._next_s is None:
            self._next_s = now_s
        if now_s < self._next_s - half_s:
            return False
        self._next_s = max(self._next_s, now_s - half_s) + self.interval_s
        return True
