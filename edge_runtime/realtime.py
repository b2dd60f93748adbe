"""The process's priority, processors and memory. Loaded only where any of them is asked for."""

from __future__ import annotations

import ctypes
import os
import resource
from typing import Any, Callable, List, Sequence, Tuple

from edge_runtime import log

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def claim_resources(priority: int, cpus: Sequence[int], lock_memory: bool) -> List[str]:
    """Apply what is asked for (0, empty and False ask for nothing), before a thread
    that drives is started.

    The threads of Zenoh, of the policy and of the vehicle inherit what the main thread has. What
    the system refuses is logged, one line each, and its name is in the list returned.
    """
    usable = ",".join(map(str, sorted(os.sched_getaffinity(0))))
    rows: Sequence[Tuple[str, Any, Callable[[Any], None], str]] = (
        # FIFO: it runs until it waits. Linux itself leaves 5 % of each second to all others.
        ("realtime_priority", priority,
         lambda it: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(it)),
         "allow it with LimitRTPRIO=99 in the service, CAP_SYS_NICE, or ulimit -r 99"),
        ("cpus", cpus, _set_cpus, f"this process may use {usable}"),
        ("lock_memory", lock_memory, _lock_memory,
         "allow it with LimitMEMLOCK=infinity in the service, CAP_IPC_LOCK, or ulimit -l"),
    )  # fmt: skip
    refused = []
    for key, value, apply, words in rows:
        try:
            if value:
                apply(value)
        except (OSError, ValueError, AttributeError) as error:
            log.event("warning", "not_permitted", key=key, value=value, detail=error, help=words)
            refused.append(key)
    return refused


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
