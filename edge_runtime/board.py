"""How the computer under the runtime is: temperature, load, memory. Linux only; else unknown."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import NamedTuple, Optional

PERIOD_S = 2.0
_THERMAL = Path("/sys/class/thermal")
_STATM = Path("/proc/self/statm")


class Board(NamedTuple):
    """One look. `temperature_c`: the hottest sensor in degrees Celsius, None without any."""

    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0


def look(thermal: Path = _THERMAL, statm: Path = _STATM) -> Board:
    """Read the sensors now. Some take milliseconds to answer: never in the control thread."""
    return Board(_hottest_c(thermal), os.getloadavg()[0], _rss_mb(statm))


def _hottest_c(thermal: Path) -> Optional[float]:
    hottest: Optional[float] = None
    for sensor in thermal.glob("thermal_zone*/temp"):
        try:
            value_c = int(sensor.read_text()) / 1000.0
        except (OSError, ValueError):  # a sensor that is switched off answers with an error
            continue
        hottest = value_c if hottest is None else max(hottest, value_c)
    return hottest


def _rss_mb(statm: Path) -> float:
    try:
        pages = int(statm.read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class BoardWatch:
    """Looks every 2 s in a thread of its own, and keeps the last look."""

    def __init__(self) -> None:
        self.last = look()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="board", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, without waiting for a sensor that hangs."""
        self._stopping.set()

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            self.last = look()
