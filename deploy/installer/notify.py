"""The hearing end of sd_notify(3): what systemd would hear of a service."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path


class NotifySocket:
    """Listens in a folder; counts what one service says."""

    def __init__(self, folder: Path, owner: int | None = None) -> None:
        self.ready = False
        self.pings = 0
        self.last_ping_s = time.monotonic()
        self._path = str(folder / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._path)
        if owner is not None:
            os.chown(str(folder), owner, -1)
            os.chown(self._path, owner, -1)

    def environment(self, watchdog_s: float) -> dict[str, str]:
        """What the service must have in its environment."""
        return {"NOTIFY_SOCKET": self._path, "WATCHDOG_USEC": str(int(watchdog_s * 1e6))}

    def forget(self) -> None:
        """The next service begins."""
        self.receive(0.0)
        self.ready, self.pings, self.last_ping_s = False, 0, time.monotonic()

    def receive(self, wait_s: float) -> None:
        """Take what has come, waiting for the first of it."""
        self._socket.settimeout(wait_s or 1e-6)
        while True:
            try:
                lines = self._socket.recv(4096).decode("utf-8", "replace").split("\n")
            except (socket.timeout, BlockingIOError):
                return
            self._socket.settimeout(1e-6)
            if "READY=1" in lines:
                # From here on it must say that it works: a slow start was no silence.
                self.ready, self.last_ping_s = True, time.monotonic()
            if "WATCHDOG=1" in lines:
                self.pings += 1
                self.last_ping_s = time.monotonic()

    def __enter__(self) -> NotifySocket:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
