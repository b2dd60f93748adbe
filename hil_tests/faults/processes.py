"""A command of this repository as a process whose every line is stamped when it comes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

PATIENCE_S = 30.0
POLL_S = 0.002
_CRASH_MARKS = ("Traceback (most recent call last)", "panicked at", "Fatal Python error")


class Process:
    """``python -m ARGUMENTS``; ``on_line(monotonic_s, line)`` hears stdout and stderr.

    ``told``: it reads its standard input, and `tell` writes there.
    """

    def __init__(
        self,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        told: bool = False,
        on_line: Callable[[float, str], None] = lambda seen_s, line: None,
    ) -> None:
        self.lines: list[tuple[float, str]] = []
        self.ended_by_us = False
        self._on_line = on_line
        self._process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.PIPE if told else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="surrogateescape",  # what is no text goes through as it is
            env={**os.environ, **(environment or {})},
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def wait_for_line(self, text: str, timeout_s: float = PATIENCE_S) -> float:
        """When the first line with ``text`` came, monotonic s."""
        return float(
            wait_until(
                lambda: next((seen_s for seen_s, line in self.lines if text in line), None),
                f"{text!r} from pid {self.pid}: {self.lines[-3:]}",
                timeout_s,
            )
        )

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it at once, and wait until it is gone."""
        self.ended_by_us = True
        self._process.kill()
        self._process.wait()
        self._reader.join(1.0)

    def end(self, timeout_s: float = 10.0) -> int:
        """SIGTERM (or nothing, where it ended itself), then its exit status."""
        self.ended_by_us = True
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
        try:
            return self.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return -signal.SIGKILL

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """The exit status, once it has ended by itself."""
        self.ended_by_us = True
        status = self._process.wait(timeout_s)
        self._reader.join(1.0)
        return status

    def crashed(self) -> bool:
        """Whether it ended on its own, or said what a crash says."""
        gone = self._process.poll() is not None and not self.ended_by_us
        return gone or any(mark in line for _, line in self.lines for mark in _CRASH_MARKS)

    def resident_mb(self) -> float:
        """Resident memory, MB (10^6 bytes)."""
        return resident_mb(self.pid)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            seen_s = time.monotonic()
            self.lines.append((seen_s, line.rstrip()))
            self._on_line(seen_s, line)


def resident_mb(pid: int) -> float:
    """Resident memory of a process, MB (10^6 bytes), from the kernel's own count."""
    with open(f"/proc/{pid}/status") as lines:
        kib = next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))
    return kib * 1024 / 1e6


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
    """Poll until the condition is true and return its value; TimeoutError otherwise."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        value = condition()
        if value:
            return value
        time.sleep(POLL_S)
    raise TimeoutError(f"not within {timeout_s:g} s: {what}")
