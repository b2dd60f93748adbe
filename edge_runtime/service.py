"""What the runtime tells of itself: to systemd (sd_notify(3), Type=notify), and in its health.

The board's sensors are Linux's; elsewhere they are unknown.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections import deque
from pathlib import Path
from typing import Deque, Dict, Mapping, NamedTuple, Optional

import numpy as np

from edge_runtime import log

WINDOW = 1024
_LOOK_PERIOD_S = 2.0
_THERMAL = Path("/sys/class/thermal")
_STATM = Path("/proc/self/statm")


class Notifier:
    """Says READY, WATCHDOG, STATUS and STOPPING to systemd; says nothing where it is not there.

    Never waits: a message for which systemd has no room is dropped.
    """

    def __init__(self, environment: Optional[Mapping[str, str]] = None) -> None:
        environment = os.environ if environment is None else environment
        address = environment.get("NOTIFY_SOCKET", "")
        self.watchdog_period_s = _watchdog_period_s(environment)
        self._address: Optional[str] = None
        self._socket: Optional[socket.socket] = None
        if address[:1] in ("/", "@"):
            # "@" stands for the NUL byte with which an abstract address begins.
            self._address = "\0" + address[1:] if address[0] == "@" else address
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def tell(self, text: str) -> None:
        """Send a state of sd_notify(3), like `READY=1`; never waits."""
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except BlockingIOError:
            pass
        except OSError as error:
            self._socket.close()
            self._socket = None
            log.event("warning", "systemd_not_told", detail=error)


def _watchdog_period_s(environment: Mapping[str, str]) -> Optional[float]:
    """Half of the time that systemd waits; None where it does not watch this process."""
    try:
        timeout_us = int(environment.get("WATCHDOG_USEC", "0"))
        pid = int(environment.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return None
    return timeout_us / 2e6 if timeout_us > 0 and pid == os.getpid() else None


class Board(NamedTuple):
    """One look. `temperature_c`: the hottest sensor in degrees Celsius, None without any."""

    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0


def look(thermal: Path = _THERMAL, statm: Path = _STATM) -> Board:
    """Read the sensors now. Some take milliseconds to answer: never in the control thread."""
    return Board(_hottest_c(thermal), os.getloadavg()[0], _rss_mb(statm))


def _hottest_c(thermal: Path) -> Optional[float]:
    values_c = []
    for sensor in thermal.glob("thermal_zone*/temp"):
        # A sensor that is switched off answers with an error.
        with contextlib.suppress(OSError, ValueError):
            values_c.append(int(sensor.read_text()) / 1000.0)
    return max(values_c, default=None)


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
        while not self._stopping.wait(_LOOK_PERIOD_S):
            self.last = look()


class LatencyWindow:
    """Quantiles of the last WINDOW durations. Not thread-safe: the caller holds a lock."""

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
