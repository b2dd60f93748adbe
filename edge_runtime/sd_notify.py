"""What systemd wants to hear of a service (Type=notify): sd_notify(3), without its library."""

from __future__ import annotations

import os
import socket
from typing import Mapping, Optional

from edge_runtime import log


class Notifier:
    """Says READY, WATCHDOG, STATUS and STOPPING to systemd; says nothing where it is not there.

    Never waits: a message for which systemd has no room is dropped.
    """

    def __init__(self, environment: Optional[Mapping[str, str]] = None) -> None:
        environment = os.environ if environment is None else environment
        address = environment.get("NOTIFY_SOCKET", "")
        self.watchdog_period_s = _watchdog_period_s(environment)
        self._address: Optional[str] = None
        self._socket: Optional[socket.socket] = None
        if address[:1] in ("/", "@"):
            # "@" stands for the NUL byte with which an abstract address begins.
            self._address = "\0" + address[1:] if address[0] == "@" else address
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def ready(self, status: str) -> None:
        """The runtime listens to states."""
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """A line for `systemctl status`."""
        self._send(f"STATUS={status}")

    def watchdog(self) -> None:
        """The runtime works. Say it every `watchdog_period_s`, or systemd restarts the service."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The runtime ends because it was asked to."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except BlockingIOError:
            pass
        except OSError as error:
            self._socket.close()
            self._socket = None
            log.event("warning", "systemd_not_told", detail=error)


def _watchdog_period_s(environment: Mapping[str, str]) -> Optional[float]:
    """Half of the time that systemd waits; None where it does not watch this process."""
    try:
        timeout_us = int(environment.get("WATCHDOG_USEC", "0"))
        pid = int(environment.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return None
    return timeout_us / 2e6 if timeout_us > 0 and pid == os.getpid() else None
