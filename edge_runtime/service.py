"""The runtime as a service on a board: systemd (sd_notify(3), Type=notify), sensors, durations."""

from __future__ import annotations

import contextlib
import math
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
    """Sends messages to systemd, if that started the process; drops one that finds no room."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self.watchdog_period_s = math.inf
        """Half of the time that systemd waits; inf where it does not watch this process."""
        if int(environment.get("WATCHDOG_PID", os.getpid())) == os.getpid():
            self.watchdog_period_s = int(environment.get("WATCHDOG_USEC", "0")) / 2e6 or math.inf
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the NUL byte with which an abstract address begins.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def tell(self, text: str) -> None:
        if self._address:
            try:
                self._socket.sendto(text.encode(), self._address)
            except OSError as error:  # full, or gone
                log.event("debug", "systemd_not_told", detail=error)


class Board(NamedTuple):
    """The board now. `temperature_c`: its hottest sensor in degrees Celsius, None without any."""

    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0


def look(thermal: str = "/sys/class/thermal") -> Board:
    """Read the sensors. Some take milliseconds to answer: never in the control thread."""
    temperatures_c = []
    for sensor in Path(thermal).glob("thermal_zone*/temp"):
        # A sensor that is switched off answers with an error.
        with contextlib.suppress(OSError, ValueError):
            temperatures_c.append(int(sensor.read_text()) / 1000.0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    rss_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return Board(max(temperatures_c, default=None), os.getloadavg()[0], rss_mb)


def peak_memory_mb() -> float:
    """Return the peak memory of this process; getrusage would include its parent's."""
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024e-6


class BoardWatch:
    """Reads the board every 2 s in a thread, and keeps the last reading."""

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
    p50, p99, top = np.percentile(np.array([*durations_ns] or [0]) / 1e6, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(top)}
