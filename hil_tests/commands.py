"""Running the repository's own commands as processes, the way a person would."""

from __future__ import annotations

import shlex
import socket
import subprocess
import sys

from edge_runtime.errors import UserError

STOP_TIMEOUT_S = 10.0


def run_command(*arguments: str) -> None:
    """Print ``python -m ...`` and run it to its end, its output passed through.

    Raises:
        UserError: it failed; it has said why.
    """
    print(f"\n$ python -m {shlex.join(arguments)}", flush=True)
    status = subprocess.run([sys.executable, "-m", *arguments], check=False).returncode
    if status:
        raise UserError(f"python -m {arguments[0]} {arguments[1]} ended with status {status}")


class BackgroundCommand:
    """``python -m ...`` running beside us for the length of a ``with`` block.

    Args:
        arguments: module and its arguments.
        ready: text of the line on its standard output that says it has started; None: no wait.
    """

    def __init__(self, *arguments: str, ready: str | None = None) -> None:
        print(f"\n$ python -m {shlex.join(arguments)} &", flush=True)
        self.name = " ".join(arguments[:2])
        self._process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=subprocess.PIPE if ready else subprocess.DEVNULL,
            stderr=subprocess.DEVNULL if ready else None,
            text=True,
        )
        if ready:
            self._wait_for(ready)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def wait(self, timeout_s: float) -> int:
        """The exit status, once it has ended by itself."""
        return self._process.wait(timeout_s)

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

    def _wait_for(self, ready: str) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if ready in line:
                return
        raise UserError(f"python -m {self.name} ended with status {self._process.wait()}")


def free_endpoint() -> str:
    """A Zenoh endpoint on loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
