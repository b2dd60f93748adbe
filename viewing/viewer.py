"""rerun's viewer as a process of its own, on loopback: by itself it would bind all interfaces."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence

import rerun as rr

from edge_runtime.util import UserError

LOOPBACK = "127.0.0.1"
START_S = 30.0
"""How long it may take until it listens."""
LOOK_S = 0.05
FLUSH_S = 5.0
"""How long it may take to receive what was drawn."""
END_S = 1.0
"""How long a viewer that takes no more may take to end."""


class ViewerGone(UserError):  # noqa: N818 (to a training it is no error)
    """The viewer has ended, hangs, or never came."""

    def __init__(self, why: str) -> None:
        super().__init__(f"viewer gone: {why}")
        self.why = why


def flush(recording: rr.RecordingStream) -> None:
    """Wait until all that was drawn has arrived; ViewerGone where it does not."""
    try:
        recording.flush(timeout_sec=FLUSH_S)
    except RuntimeError as error:
        raise ViewerGone(str(error)) from None


class Viewer:
    """A viewer that listens.

    Args:
        options: of rerun's command.
        ports: at which it is to listen.

    Raises:
        ViewerGone: it ends at once, or does not listen in time.
    """

    def __init__(self, options: Sequence[str], ports: Sequence[int]) -> None:
        command = [sys.executable, "-m", "rerun_cli", "--bind", LOOPBACK, *options]
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 (closed by the last who writes)
        # A group of its own: ^C is not for it, and it ends with the child that the module starts.
        self._process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            env={**os.environ, "RERUN_APP_ONLY": "true"},  # As rerun's own spawn: no questions.
            start_new_session=True,
        )
        try:
            self._await(ports)
        except BaseException:
            self.end()
            raise

    def end(self) -> None:
        """End it, even where it hangs."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def leave(self, recording: rr.RecordingStream) -> None:
        """Disconnect from it; ViewerGone where it hangs, which rerun would wait for, for ever."""
        patience = threading.Timer(FLUSH_S, self.end)
        patience.start()
        recording.disconnect()
        if not patience.is_alive():
            raise ViewerGone("it hangs")
        patience.cancel()

    def last_words(self, wait_s: float = 0.0) -> str:
        """Why it has ended; empty where it runs on for so long."""
        try:
            self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            return ""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").split("\n")
        words = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
        return words[-1] if words else "it was closed"

    def _await(self, ports: Sequence[int]) -> None:
        end_s = time.monotonic() + START_S
        while not all(map(_answers, ports)):
            words = self.last_words()
            if words or time.monotonic() > end_s:
                raise ViewerGone(words or f"it does not listen after {START_S:.0f} s")
            time.sleep(LOOK_S)


def free_port() -> int:
    """One on which nobody listens."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _answers(port: int) -> bool:
    try:
        socket.create_connection((LOOPBACK, port), LOOK_S).close()
    except OSError:
        return False
    return True
