"""The speeds that a vehicle reported lately, and what follows from them. No clock."""

from __future__ import annotations

from collections import deque
from typing import Deque, Tuple

from edge_runtime.wire import CONTROL_PERIOD_S

STANDS_MPS = 0.02
IMPOSSIBLE = 1.3
"""Times what the model can do: who reports more than that is not believed."""
_SLACK_S = 0.01


class Speeds:
    """Those of the last control period; monotonic seconds are passed in."""

    def __init__(self) -> None:
        self._noted: Deque[Tuple[float, float]] = deque()

    def note(self, speed_mps: float, now_s: float) -> None:
        """The newest one."""
        self._noted.append((now_s, speed_mps))
        while self._noted[0][0] < now_s - CONTROL_PERIOD_S - _SLACK_S:
            self._noted.popleft()

    def forget(self) -> None:
        """As before the first one."""
        self._noted.clear()

    @property
    def newest_mps(self) -> float:
        """0 before the first."""
        return self._noted[-1][1] if self._noted else 0.0

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return abs(self.newest_mps) < STANDS_MPS

    def acceleration_mps2(self) -> float:
        """Over the last control period; 0 while there is too little to tell."""
        if len(self._noted) < 2:
            return 0.0
        (since_s, before_mps), (now_s, speed_mps) = self._noted[0], self._noted[-1]
        return (speed_mps - before_mps) / (now_s - since_s) if now_s > since_s else 0.0
