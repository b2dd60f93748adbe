"""Run the repository's own commands as processes, and an operator beside a drive."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from edge_runtime.link import ask
from edge_runtime.util import UserError
from trainer.util import kept

POLICY = Path(kept("results/policies/left_turn.onnx"))
PUBLIC_KEY = POLICY.with_name("policy.pub")  # The shipped policy, and its signer's key
PATIENCE_S = 30.0
OPERATOR_LOOKS_EVERY_S = 0.5
_LAST_WORDS_S = 1.0
# Otherwise an edge runtime, which waits for a simulator for ever, outlives a killed command.
_ENDS_WITH_US = ["setpriv", "--pdeathsig", "TERM", "--"] if shutil.which("setpriv") else []
_CRASH_MARKS = ("Traceback (most recent call last)", "panicked at", "Fatal Python error")


class CommandTimeoutError(UserError, TimeoutError):
    """A command did not end, or an event did not come, in time."""


class Process:
    """``python -m ARGUMENTS`` beside us. It ends with the block, or the thread that started it.

    ``lines`` are its output with monotonic times; ``output`` and ``errors`` the text of each
    stream. The constructor waits until the text ``ready`` is printed; UserError if it never is.
    ``shown`` prints the command; ``environment`` adds variables, ``options`` are Popen's.
    """

    def __init__(
        self,
        *arguments: object,
        ready: str | None = None,
        shown: bool = False,
        environment: Mapping[str, str] | None = None,
        python: str = sys.executable,
        **options: Any,
    ) -> None:
        if shown:
            print(f"\n$ python -m {shlex.join(map(str, arguments))} &", flush=True)
        self.name = " ".join(map(str, arguments[:2]))
        self.lines: list[tuple[float, str]] = []
        self._ended_by_us = False
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self._process: subprocess.Popen[str] = subprocess.Popen(
            [*_ENDS_WITH_US, python, "-m", *map(str, arguments)],
            text=True,
            errors="surrogateescape",
            env={**os.environ, **(environment or {})},
            **{**pipes, **options},
        )
        self.pid = self._process.pid
        self._texts: dict[str, list[str]] = {"stdout": [], "stderr": []}
        self._readers = [
            threading.Thread(target=self._read, args=(stream,), daemon=True)
            for stream in self._texts
        ]
        for reader in self._readers:
            reader.start()
        if ready is not None:
            with contextlib.suppress(TimeoutError):
                wait_until(lambda: self.has_ended or self._when(ready), self.name)
            if self.has_ended or self._when(ready) is None:
                self.end()
                raise self._failure()

    @property
    def output(self) -> str:
        return "".join(self._texts["stdout"])

    @property
    def errors(self) -> str:
        return "".join(self._texts["stderr"])

    @property
    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def wait_for_line(self, text: str) -> float:
        """Wait for the first line with ``text``; return when it came, monotonic s."""
        return float(wait_until(lambda: self._when(text), f"{text!r} from pid {self.pid}"))

    def tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        self._process.kill()
        self.wait()

    def end(self) -> int:
        """Send SIGTERM if it still runs; return its exit status."""
        if not self.has_ended:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
        try:
            return self.wait(PATIENCE_S)
        except TimeoutError:
            self.kill()
            return -signal.SIGKILL

    def wait(self, timeout_s: float = 2 * PATIENCE_S) -> int:
        self._ended_by_us = True
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            text = f"python -m {self.name} did not end within {timeout_s:g} s"
            raise CommandTimeoutError(text) from None
        for reader in self._readers:
            reader.join(_LAST_WORDS_S)
        return status

    def succeed(self, timeout_s: float = 2 * PATIENCE_S) -> None:
        """Wait until it ends; UserError with its last line where it failed."""
        if self.wait(timeout_s):
            raise self._failure()

    def crashed(self) -> bool:
        """Return whether it ended by itself unawaited, or printed the text of a crash."""
        vanished = self.has_ended and not self._ended_by_us
        return vanished or any(mark in line for _, line in self.lines for mark in _CRASH_MARKS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _when(self, text: str) -> float | None:
        return next((seen_s for seen_s, line in self.lines if text in line), None)

    def _failure(self) -> UserError:
        lines = (self.errors.strip() or self.output.strip() or "it printed nothing").splitlines()
        return UserError(f"python -m {self.name}: {lines[-1]}")

    def _read(self, stream: str) -> None:
        for line in getattr(self._process, stream) or ():
            seen_s = time.monotonic()
            self._texts[stream].append(line)
            self.lines.append((seen_s, line.rstrip()))


@contextlib.contextmanager
def operator(endpoint: str, vehicle_id: str) -> Iterator[None]:
    """Re-arm a vehicle after each safe stop, in place of an operator."""
    end = threading.Event()

    def operate() -> None:
        while not end.wait(OPERATOR_LOOKS_EVERY_S):
            with contextlib.suppress(UserError):  # no runtime yet, or no more
                status = ask(endpoint, vehicle_id, "status")
                stopped = status["needs_rearm"] and status["mode"] == "safe_stop"
                if stopped and ask(endpoint, vehicle_id, "rearm")["accepted"]:
                    print(f"operator: re-armed {vehicle_id} after {status['reason']}", flush=True)

    thread = threading.Thread(target=operate)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def run_command(*arguments: object) -> None:
    """Print ``python -m ...`` and run it to its end; UserError if it failed (it has said why)."""
    words = ["python", "-m", *map(str, arguments)]
    print(f"\n$ {shlex.join(words)}", flush=True)
    # Not `subprocess.call`, which after ^C kills a command that may still save something.
    with subprocess.Popen([sys.executable, *words[1:]]) as process:
        status = process.wait()
    if status:
        raise UserError(f"{' '.join(words[:4])} ended with status {status}")


def wait_until(
    condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S, poll_s: float = 0.005
) -> Any:
    """Poll until the condition is true and return its value; CommandTimeoutError otherwise."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if value := condition():
            return value
        time.sleep(poll_s)
    raise CommandTimeoutError(f"not within {timeout_s:g} s: {what}")
