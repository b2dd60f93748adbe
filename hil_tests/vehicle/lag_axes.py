"""The table of lags: every dead time with every time constant, and a line through it each way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from hil_tests.campaign.axes import Axis

DEAD_TIMES_MS = (0, 50, 100, 200, 300, 400, 500, 600, 800)
TIME_CONSTANTS_MS = (20, 50, 100, 200, 300, 500, 750, 1000)
LINE_DEAD_MS, LINE_CONSTANT_MS = 50, 100
"""Where the lines lie: of the table, the values nearest to the mock's own (30 and 100 ms)."""


class Lag(NamedTuple):
    """One point of the table."""

    dead_ms: int
    constant_ms: int

    @property
    def spec(self) -> str:
        """Its name in the report."""
        return f"dead={self.dead_ms}ms,constant={self.constant_ms}ms"

    @property
    def sum_ms(self) -> int:
        """The lag that a slow change sees."""
        return self.dead_ms + self.constant_ms

    def changes(self) -> dict[str, float]:
        """The mock's parameters."""
        return {
            "dead_time_s": self.dead_ms / 1e3,
            "speed_time_constant_s": self.constant_ms / 1e3,
        }


@dataclass(frozen=True)
class LagAxis(Axis):
    """A line of the table, for the campaign's budget and figures."""

    def spec(self, value: float) -> str:
        """The name of a point."""
        return self.pattern.format(f"{value:g}")


LAGS = [Lag(dead, constant) for dead in DEAD_TIMES_MS for constant in TIME_CONSTANTS_MS]
LAG_AXES = (
    LagAxis(
        "dead_time",
        f"dead time, with a time constant of {LINE_CONSTANT_MS} ms",
        "ms",
        DEAD_TIMES_MS,
        f"dead={{}}ms,constant={LINE_CONSTANT_MS}ms",
        Lag(DEAD_TIMES_MS[0], LINE_CONSTANT_MS).spec,
        f"{{}} of dead time (time constant {LINE_CONSTANT_MS} ms)",
    ),
    LagAxis(
        "time_constant",
        f"time constant, with a dead time of {LINE_DEAD_MS} ms",
        "ms",
        TIME_CONSTANTS_MS,
        f"dead={LINE_DEAD_MS}ms,constant={{}}ms",
        Lag(LINE_DEAD_MS, TIME_CONSTANTS_MS[0]).spec,
        f"{{}} of time constant (dead time {LINE_DEAD_MS} ms)",
    ),
)
