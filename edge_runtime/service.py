"""The runtime as a service: what it tells systemd (sd_notify(3), Type=notify), its own health.

The board's sensors are Linux's; elsewhere they are unknown.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from pathlib import Path
from typing import Collection, Dict, Mapping, NamedTuple, Optional

import numpy as np

from edge_runtime import log

WINDOW = 1024
_LOOK_PERIOD_S = 2.0


class Notifier:
    """Says READY, WATCHDOG, STATUS and STOPPING to systemd; says nothing where it is not there.

    Never waits: a message for which systemd has no room is dropped.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self.watchdog_period_s: Optional[float] = None
        """Half of the time that systemd waits; None where it does not watch this process."""
        with contextlib.suppress(ValueError):
            timeout_us = int(environment.get("WATCHDOG_USEC", "0"))
            pid = int(environment.get("WATCHDOG_PID", os.getpid()))
            if timeout_us > 0 and pid == os.getpid():
                self.watchdog_period_s = timeout_us / 2e6
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the NUL byte with which an abstract address begins.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: Optional[socket.socket] = None
        if self._address.startswith(("/", "\0")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def tell(self, text: str) -> None:
        """Send a state of sd_notify(3), like `READY=1`; never waits."""
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except BlockingIOError:
            pass
        except OSError as error:
            self._socket.close()
            self._socket = None
            log.event("warning", "systemd_not_told", detail=error)


class Board(NamedTuple):
    """One look. `temperature_c`: the hottest sensor in degrees Celsius, None without any."""

    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0


def look(thermal: str = "/sys/class/thermal", statm: str = "/proc/self/statm") -> Board:
    """Read the sensors now. Some take milliseconds to answer: never in the control thread."""
    temperatures_c, rss_mb = [], 0.0
    for sensor in Path(thermal).glob("thermal_zone*/temp"):
        # A sensor that is switched off answers with an error.
        with contextlib.suppress(OSError, ValueError):
            temperatures_c.append(int(sensor.read_text()) / 1000.0)
    with contextlib.suppress(OSError, ValueError, IndexError):
        rss_mb = int(Path(statm).read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return Board(max(temperatures_c, default=None), os.getloadavg()[0], rss_mb)


def peak_memory_mb() -> Optional[float]:
    """The most memory that this process has held so far; None where the system does not say."""
    with contextlib.suppress(OSError, LookupError, ValueError):  # getrusage has its parent's, too
        return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024e-6
    return None


class BoardWatch:
    """Looks every 2 s in a thread of its own, and keeps the last look."""

    def __init__(self) -> None:
        self.last = look()
        self._stopping = threading.Event()
        threading.Thread(target=self._run, name="board", daemon=True).start()

    def close(self) -> None:
        """End the thread, without waiting for a sensor that hangs."""
        self._stopping.set()

    def _run(self) -> None:
        while not self._stopping.wait(_LOOK_PERIOD_S):
            self.last = look()


def quantiles_ms(durations_ns: Collection[int]) -> Dict[str, float]:
    """p50, p99 and max in milliseconds; zeros where there is none."""
    p50, p99, top = np.percentile(np.array([*durations_ns] or [0]) / 1e6, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(top)}
