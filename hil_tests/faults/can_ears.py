"""Ears on a CAN bus: when each frame was there, by the kernel's own stamp. They never speak."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import NamedTuple

import can

from edge_runtime.vehicles.can_bus import open_bus

_POLL_S = 0.1


class Heard(NamedTuple):
    """A frame, and its monotonic time."""

    seen_s: float
    can_id: int
    data: bytes


class CanEars:
    """Hears all frames of a bus in a thread, and keeps those of the identifiers asked for."""

    def __init__(self, bus: str, can_ids: tuple[int, ...]) -> None:
        self.heard: list[Heard] = []
        self._can_ids = frozenset(can_ids)
        self._bus = open_bus(bus)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def of(self, can_id: int, since_s: float = float("-inf")) -> list[Heard]:
        """The frames of an identifier since a moment, in order."""
        return [one for one in list(self.heard) if one.can_id == can_id and one.seen_s > since_s]

    def close(self) -> None:
        """End the thread, then close the bus."""
        self._ending.set()
        self._thread.join()
        self._bus.shutdown()

    def _listen(self) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(can.CanError):
                message = self._bus.recv(_POLL_S)
                if message is not None and message.arbitration_id in self._can_ids:
                    # The stamp is the kernel's, by the wall clock: how late this thread runs
                    # does not count.
                    seen_s = message.timestamp + time.monotonic() - time.time()
                    data = bytes(message.data)
                    self.heard.append(Heard(seen_s, message.arbitration_id, data))
