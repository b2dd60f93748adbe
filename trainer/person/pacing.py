"""Ten control periods a second, whoever is quick or slow in between."""

from __future__ import annotations

import time
from collections.abc import Callable

LATE_S = 0.02
"""A period that begins later than this is counted: a fifth of it is about what a person feels."""


class Pacer:
    """Absolute deadlines, one a period: what is late once is not late for ever after.

    A delay of less than a period is caught up. After a longer one the deadlines begin anew: a car
    that leaps through what was missed cannot be driven.

    Args:
        period_s: wall time of a control period.
        clock: monotonic seconds.
        sleep: waits for so many seconds.
    """

    def __init__(
        self,
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_s = period_s
        self.late = 0
        """Periods that began too late."""
        self._clock, self._sleep = clock, sleep
        self.restart()

    def restart(self) -> None:
        """Let the next period begin one period from now: after a pause, or a new episode."""
        self._deadline_s = self._clock() + self.period_s

    def wait(self) -> float:
        """Wait for the next period to begin; returns by how many seconds it is late."""
        # Python's main thread sleeps on through a signal that another thread took; a period is
        # short enough to hear of it afterwards.
        while (left_s := self._deadline_s - self._clock()) > 0.0:
            self._sleep(left_s)
        late_s = max(-left_s, 0.0)
        self.late += late_s > LATE_S
        if late_s < self.period_s:
            self._deadline_s += self.period_s
        else:
            self.restart()
        return late_s
