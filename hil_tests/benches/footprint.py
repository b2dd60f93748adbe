"""Memory, idle load and start-up of a process that answers states."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hil_tests.benches.contenders import Contender, answer
from hil_tests.faults.processes import Process, resident_mb

_ANSWER_S = 5.0
_POLL_S = 0.02
_SAMPLES = 10
_FIRST_COMMAND_S = 30.0


def first_command_s(start: Callable[[], Process], contender: Contender) -> tuple[Process, float]:
    """Start a process and send states until it answers: the process, and how long that took."""
    contender.begin_block()
    begun_s = time.perf_counter()
    process = start()
    while not contender.arrivals:
        if time.perf_counter() - begun_s > _FIRST_COMMAND_S:
            process.kill()
            raise TimeoutError(f"no command within {_FIRST_COMMAND_S} s: {process.lines}")
        contender.put(contender.prepare()[1])
        time.sleep(_POLL_S)
    return process, min(contender.arrivals.values()) - begun_s


def memory_mb(
    pid: int, contender: Contender, steps: int, tick: Callable[[str], None]
) -> dict[str, Any]:
    """Resident memory at the start and after each tenth of ``steps`` answers, one by one."""
    contender.begin_block()
    samples, latencies_s = [resident_mb(pid)], []
    for part in range(_SAMPLES):
        for _ in range(steps // _SAMPLES):
            sent_s = time.perf_counter()
            latencies_s.append(answer(contender, _ANSWER_S) - sent_s)
        contender.begin_block()
        samples.append(resident_mb(pid))
        tick(f"{(part + 1) * steps // _SAMPLES:,} of {steps:,} steps")
    return {
        "steps": steps,
        "start": samples[0],
        "samples": [round(sample, 2) for sample in samples],
        "end": samples[-1],
        # The first tenth fills pools and windows; what comes after it must not grow.
        "grown_after_first_tenth": samples[-1] - samples[1],
        "answer_ms_p50": float(np.median(latencies_s)) * 1e3,
    }


def idle_load(pid: int, seconds: float) -> float:
    """The part of a core that the process uses while nobody sends anything."""
    begin, begun_s = _cpu_s(pid), time.perf_counter()
    time.sleep(seconds)
    return (_cpu_s(pid) - begin) / (time.perf_counter() - begun_s)


def _cpu_s(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as stat:
        # After the name, which may hold spaces: state is field 3, utime and stime 14 and 15.
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
