"""The runtime as a service on a board: systemd, an installer's hold, sensors, priority and memory.

It speaks sd_notify(3), Type=notify. Sensors and priorities are Linux's.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import resource
import socket
import threading
from pathlib import Path
from typing import (
    BinaryIO,
    Callable,
    Collection,
    Dict,
    Mapping,
    NamedTuple,
    Optional,
    Sequence,
)

import numpy as np

from edge_runtime import log
from edge_runtime.util import UserError, open_regular

WINDOW = 1024
_LOOK_PERIOD_S = 2.0
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


class Notifier:
    """Sends READY, WATCHDOG, STATUS and STOPPING to systemd, where it runs under systemd.

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
    """The board now. `temperature_c`: its hottest sensor in degrees Celsius, None without any."""

    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0


def look(thermal: str = "/sys/class/thermal") -> Board:
    """Read the sensors. Some take milliseconds to answer: never in the control thread."""
    temperatures_c, rss_mb = [], 0.0
    for sensor in Path(thermal).glob("thermal_zone*/temp"):
        # A sensor that is switched off answers with an error.
        with contextlib.suppress(OSError, ValueError):
            temperatures_c.append(int(sensor.read_text()) / 1000.0)
    with contextlib.suppress(OSError, ValueError, IndexError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        rss_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return Board(max(temperatures_c, default=None), os.getloadavg()[0], rss_mb)


def peak_memory_mb() -> Optional[float]:
    """Return the most memory that this process has held; None where the system does not say."""
    with contextlib.suppress(OSError, LookupError, ValueError):  # getrusage has its parent's, too
        return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024e-6
    return None


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
    """p50, p99 and max in milliseconds; zeros where there are no durations."""
    p50, p99, top = np.percentile(np.array([*durations_ns] or [0]) / 1e6, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(top)}


def claim_resources(priority: int, cpus: Sequence[int], lock_memory: bool) -> None:
    """Apply the settings of priority, processors and memory (0, empty and False: no change).

    Call it before a thread that drives is started: the threads of Zenoh, of the policy and of the
    vehicle inherit from the main thread. Each refusal of the system is logged.
    """
    if priority:  # FIFO: it runs until it waits. Linux itself leaves 5 % of each second to others.
        rank = os.sched_param(priority)
        _claim("realtime_priority", priority, lambda: os.sched_setscheduler(0, os.SCHED_FIFO, rank))
    if cpus:
        _claim("cpus", cpus, lambda: _set_cpus(cpus))
    if lock_memory:
        _claim("lock_memory", lock_memory, _lock_memory)


def _claim(key: str, value: object, apply: Callable[[], None]) -> None:
    try:
        apply()
    except (OSError, ValueError, AttributeError) as error:
        log.event("warning", "not_permitted", key=key, value=value, detail=error)


def _set_cpus(cpus: Sequence[int]) -> None:
    missing = set(cpus) - os.sched_getaffinity(0)
    if missing:  # the kernel would silently take those that exist
        raise ValueError(f"no processor {sorted(missing)} for this process")
    os.sched_setaffinity(0, cpus)


def _lock_memory() -> None:
    """Keep every page that is ever touched; pages that nobody touches take no room."""
    soft, _hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        # With a limit it would succeed now, and an allocation would fail in mid-drive.
        raise PermissionError(f"at most {soft // 1024} KiB may be locked")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        raise OSError(os.strerror(ctypes.get_errno()))


class Hold:
    """Keeps commands from wire and vehicle while an installer tries this release.

    The installer holds a lock on the file `path` for as long as it judges. The lock ends with its
    process, so an installer that dies silences no runtime. Once free, this process never asks
    again. A file that is not there holds nothing. Raises UserError for one that cannot be read.
    """

    def __init__(self, path: str) -> None:
        self._stream: Optional[BinaryIO] = None
        try:
            self._stream = open_regular(path)  # kept until it is free
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            raise UserError(f"hold {path} cannot be read: {error}") from None

    def is_on(self) -> bool:
        """Return whether commands must stay here. Never waits."""
        if self._stream is None:
            return False
        try:
            fcntl.flock(self._stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # No locks on this file system; if only for now, the next call asks.
            return False
        self._stream.close()
        self._stream = None
        return False

    def refusal(self) -> str:
        """Say why nobody may re-arm now; empty when free."""
        return "an installer tries this release; re-arm when it is done" if self.is_on() else ""
