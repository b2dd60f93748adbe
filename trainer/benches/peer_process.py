"""A peer that works in a process and an environment of its own.

The protocol, a line each way: the peer greets with a JSON object of what it is; the bench writes a
number of updates; the peer makes them and answers with a JSON list, the milliseconds of each. The
end of its input ends it.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
import threading
from types import TracebackType
from typing import Any

from edge_runtime.util import UserError

SILENCE_S = 300.0
"""No peer takes that long for a few updates."""


class PeerProcess:
    """Starts a peer and talks to it; use as a context manager.

    Args:
        name: of the peer, for errors.
        command: what to start.

    Raises:
        UserError: it does not start, or stops, or answers something else.
    """

    def __init__(self, name: str, command: list[str]) -> None:
        self.name, self.command = name, command
        self.about: dict[str, Any] = {}

    def __enter__(self) -> PeerProcess:
        self._complaints = tempfile.TemporaryFile("w+")
        try:
            self._process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._complaints,
                text=True,
                env=_environment(),
            )
        except OSError as error:
            self._complaints.close()
            raise UserError(f"{self.name} cannot be run: {error}") from error
        try:
            self.about = self._answer(dict)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Not asked to leave: an update that is under way need not be waited for.
        self._process.kill()
        self._process.communicate()
        self._complaints.close()

    def run(self, count: int) -> list[float]:
        """Milliseconds of each of ``count`` updates, measured by the peer itself."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{count}\n")
            self._process.stdin.flush()
        except OSError as error:
            raise UserError(self._gone()) from error
        times_ms = self._answer(list)
        if len(times_ms) != count or not all(_is_time(time_ms) for time_ms in times_ms):
            raise UserError(f"{self.name} was asked for {count} times and gave {times_ms}")
        return [float(time_ms) for time_ms in times_ms]

    def _answer(self, kind: type) -> Any:
        assert self._process.stdout is not None
        # A read knows no time limit, but ends when the process does.
        watch = threading.Timer(SILENCE_S, self._process.kill)
        watch.start()
        try:
            line = self._process.stdout.readline()
        finally:
            watch.cancel()
        if not line:
            raise UserError(self._gone())
        try:
            value = json.loads(line)
        except ValueError as error:
            raise UserError(f"{self.name} answered {line.strip()[:80]!r}, not JSON") from error
        if not isinstance(value, kind):
            raise UserError(f"{self.name} answered {line.strip()[:80]!r}, not a {kind.__name__}")
        return value

    def _gone(self) -> str:
        status = self._process.wait()
        self._complaints.seek(0)
        last = (self._complaints.read().strip().splitlines() or ["without a word"])[-1]
        return f"{self.name} stopped with status {status}: {last}"


def _is_time(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value) and value > 0


def _environment() -> dict[str, str]:
    """Ours without what would lead the peer's Python to our libraries."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
