"""Ears on a CAN bus: when each frame was there, by the kernel's own stamp. They never speak."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import NamedTuple

import can

from edge_runtime.vehicles.hunter.bus import open_bus, parse_bus
from edge_runtime.vehicles.hunter.protocol import FRAMES

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
        self.strange: list[Heard] = []
        """Frames that are not the Hunter's: nobody should send any."""
        self._can_ids = frozenset(can_ids)
        self._bus = open_bus(parse_bus(bus))
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
                if message is not None:
                    self._note(message)

    def _note(self, message: can.Message) -> None:
        # The stamp is the kernel's, by the wall clock: how late this thread runs does not count.
        seen_s = message.timestamp + time.monotonic() - time.time()
        heard = Heard(seen_s, message.arbitration_id, bytes(message.data))
        if heard.can_id in self._can_ids:
            self.heard.append(heard)
        if heard.can_id not in FRAMES or message.is_extended_id:
            self.strange.append(heard)
