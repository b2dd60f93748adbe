"""What systemd wants to hear of a service (Type=notify): sd_notify(3), without its library."""

from __future__ import annotations

import ctypes
import os
import resource
import socket
import threading
from collections import deque
from pathlib import Path
from typing import Callable, Deque, Dict, List, Mapping, NamedTuple, Optional, Sequence

import numpy as np

from edge_runtime import log


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

    def ready(self, status: str) -> None:
        """The runtime listens to states."""
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """A line for `systemctl status`."""
        self._send(f"STATUS={status}")

    def watchdog(self) -> None:
        """The runtime works. Say it every `watchdog_period_s`, or systemd restarts the service."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The runtime ends because it was asked to."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
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


_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def configure(priority: int, cpus: Sequence[int], lock_memory: bool) -> List[str]:
    """Apply what is asked for (0, empty and False ask for nothing).

    What the system refuses is logged, one line each, and its name is in the list returned.
    """
    refused = []
    if priority and not _try("realtime_priority", _set_priority, priority, _PRIORITY_HELP):
        refused.append("realtime_priority")
    if cpus and not _try("cpus", _set_cpus, cpus, f"this process may use {_usable()}"):
        refused.append("cpus")
    if lock_memory and not _try("lock_memory", _lock_memory, True, _MEMORY_HELP):
        refused.append("lock_memory")
    return refused


_PRIORITY_HELP = "allow it with LimitRTPRIO=99 in the service, CAP_SYS_NICE, or ulimit -r 99"
_MEMORY_HELP = "allow it with LimitMEMLOCK=infinity in the service, CAP_IPC_LOCK, or ulimit -l"


def _try(key: str, apply: Callable, value: object, help_text: str) -> bool:
    try:
        apply(value)
    except (OSError, ValueError, AttributeError) as error:
        log.event("warning", "not_permitted", key=key, value=value, detail=error, help=help_text)
        return False
    return True


def _set_priority(priority: int) -> None:
    # FIFO: it runs until it waits. Linux itself leaves 5 % of each second to all others.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def _set_cpus(cpus: Sequence[int]) -> None:
    missing = set(cpus) - os.sched_getaffinity(0)
    if missing:  # the kernel would silently take those that exist
        raise ValueError(f"no processor {sorted(missing)} for this process")
    os.sched_setaffinity(0, cpus)


def _lock_memory(_: object) -> None:
    """Keep every page that is ever touched; pages that nobody touches take no room."""
    soft, _hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        # With a limit it would succeed now, and an allocation would fail in mid-drive.
        raise PermissionError(f"at most {soft // 1024} KiB may be locked")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _usable() -> str:
    return ",".join(map(str, sorted(os.sched_getaffinity(0))))


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


WINDOW = 1024


class LatencyWindow:
    """The last WINDOW durations. Not thread-safe: the caller holds a lock."""

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
