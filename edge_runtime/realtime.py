"""Priority, processors and memory of this process: asked for, never required.

Called before any other thread starts: the threads of Zenoh, of the policy and of the vehicle
inherit what the main thread has.
"""

from __future__ import annotations

import ctypes
import os
import resource
from typing import Callable, List, Sequence

from edge_runtime import log

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PRIORITY_HELP = "allow it with LimitRTPRIO=99 in the service, CAP_SYS_NICE, or ulimit -r 99"
_MEMORY_HELP = "allow it with LimitMEMLOCK=infinity in the service, CAP_IPC_LOCK, or ulimit -l"


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
