"""Running the repository's own commands as processes, the way a person would."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from edge_runtime.util import UserError

START_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 10.0


class CommandTimeoutError(UserError):
    """A command had not ended when its time was over."""


def run_command(*arguments: str) -> None:
    """Print ``python -m ...`` and run it to its end, its output passed through.

    Raises:
        UserError: it failed; it has said why.
    """
    print(f"\n$ python -m {shlex.join(arguments)}", flush=True)
    process = subprocess.Popen([sys.executable, "-m", *arguments])
    try:
        status = process.wait()
    except KeyboardInterrupt:
        # It has had the same ^C, and may have something to keep. A second one is for good.
        try:
            process.wait()
        finally:
            process.kill()
        raise
    if status:
        raise UserError(f"python -m {arguments[0]} {arguments[1]} ended with status {status}")


def end_children() -> None:
    """Ask every process that this one has started to end, whichever thread waits for it."""
    for children in Path("/proc/self/task").glob("*/children"):
        for child in children.read_text().split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGTERM)


class BackgroundCommand:
    """``python -m ...`` running beside us for the length of a ``with`` block.

    Its output is kept aside and quoted if it fails.

    Args:
        arguments: module and its arguments.
        ready: text of its output that says it has started; None: no wait.
        prefix: a program that runs it, as in ``ip netns exec NAME``.
        quiet: do not print the command.
    """

    def __init__(
        self,
        *arguments: str,
        ready: str | None = None,
        prefix: Sequence[str] = (),
        quiet: bool = False,
    ) -> None:
        if not quiet:
            print(f"\n$ python -m {shlex.join(arguments)} &", flush=True)
        self.name = " ".join(arguments[:2])
        self._output = tempfile.TemporaryFile(mode="w+")  # noqa: SIM115 (closed in __exit__)
        self._process = subprocess.Popen(
            [*prefix, sys.executable, "-m", *arguments],
            stdout=self._output,
            stderr=subprocess.STDOUT,
        )
        if ready:
            self._wait_for(ready)

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended by itself.

        Raises:
            CommandTimeoutError: it has not.
            UserError: it failed.
        """
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            said = f"python -m {self.name} did not end within {timeout_s:g} s"
            raise CommandTimeoutError(said) from None
        if status:
            raise self._failure()

    def __enter__(self) -> BackgroundCommand:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.terminate()
        try:
            self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()

    def _wait_for(self, ready: str) -> None:
        end_s = time.monotonic() + START_TIMEOUT_S
        while ready not in self.said():
            if self._process.poll() is not None or time.monotonic() > end_s:
                failure = self._failure()
                self.__exit__()
                raise failure
            time.sleep(0.02)

    def said(self) -> str:
        """All of its output so far."""
        self._output.seek(0)
        return self._output.read()

    def _failure(self) -> UserError:
        last = (self.said().strip().splitlines() or ["it said nothing"])[-1]
        return UserError(f"python -m {self.name}: {last}")
