"""Probes: disk, memory, priorities, programs."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hil_tests.doctor.check import MissingError, output_of

DISK_BYTES = 2 * 10**9
"""A training run with its checkpoint takes some 0.5 GB, recordings and pictures come on top."""
MEMORY_BYTES = 2 * 10**9
"""A full replay buffer and torch take 1.2 GB."""


def disk() -> str:
    """Room where runs are written by default, and the right to write there."""
    with tempfile.NamedTemporaryFile(dir=Path.cwd(), prefix=".doctor-") as file:
        file.write(b"doctor")
    free = shutil.disk_usage(Path.cwd()).free
    if free < DISK_BYTES:
        raise MissingError(f"{free / 1e9:.1f} GB are free here, {DISK_BYTES / 1e9:.0f} are wanted")
    return f"{free / 1e9:.0f} GB free in {Path.cwd()}"


def memory() -> str:
    """Memory that could be had now."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    available = next(int(line.split()[1]) * 1024 for line in lines if "MemAvailable" in line)
    if available < MEMORY_BYTES:
        raise MissingError(f"{available / 1e9:.1f} GB available, {MEMORY_BYTES / 1e9:.0f} wanted")
    return f"{available / 1e9:.0f} GB available, {os.cpu_count()} cores"


def realtime_priority() -> str:
    """A thread gets the priority that `edge_runtime run` may ask for."""
    try:
        # The thread keeps the priority to itself, and ends with it.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).result()
    except OSError as error:
        raise MissingError(f"SCHED_FIFO is refused: {error.strerror}") from None
    return "SCHED_FIFO was given to a thread"


def program(name: str, *arguments: str) -> Callable[[], str]:
    """A probe: the program runs, and says what it is."""

    def probe() -> str:
        if (path := shutil.which(name)) is None:
            raise MissingError(f"{name} is not installed")
        return (output_of(path, *arguments).splitlines() or [path])[0]

    return probe


def ssh() -> str:
    """OpenSSH says its version on stderr."""
    if (path := shutil.which("ssh")) is None:
        raise MissingError("ssh is not installed")
    output_of(path, "-V")
    return path


def xvfb() -> str:
    """An X server without a screen starts, and ends."""
    if (path := shutil.which("Xvfb")) is None:
        raise MissingError("Xvfb is not installed")
    reader, writer = os.pipe()
    command = [path, "-displayfd", str(writer), "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writer], stderr=subprocess.DEVNULL)
    os.close(writer)
    try:
        with os.fdopen(reader) as pipe:
            display = pipe.readline().strip()
    finally:
        server.terminate()
        server.wait()
    if not display:
        raise MissingError("Xvfb ends at once")
    return f"display :{display} came up and went"


def chromium() -> str:
    """A browser that runs without a screen."""
    from trainer.util import CHROMIUM, find_chromium

    if (path := find_chromium()) is None:
        raise MissingError(f"none of {', '.join(CHROMIUM)} is installed")
    return output_of(path, "--version")
