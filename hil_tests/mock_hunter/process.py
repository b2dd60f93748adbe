"""The mock on a bus: the clock, the sockets and the switches around it."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TextIO

import can

from edge_runtime.util import UserError
from hil_tests.mock_hunter.faults import check_fault
from hil_tests.mock_hunter.hunter import MockHunter

Switch = tuple[str, bool]
"""A fault's name, and whether it is switched on."""
_WORDS = {"on": True, "off": False}


def parse_switch(line: str) -> Switch:
    """``NAME on`` or ``NAME off``. Raises UserError for anything else."""
    name, _, word = line.strip().partition(" ")
    if word not in _WORDS:
        raise UserError(f"{line.strip()!r} is no order: use NAME on, or NAME off")
    return check_fault(name), _WORDS[word]


class Orders:
    """Lines of a text stream, read by a thread so that nobody waits for them."""

    def __init__(self, lines: TextIO, complain: Callable[[str], None]) -> None:
        self._queue: queue.SimpleQueue[Switch] = queue.SimpleQueue()
        self._complain = complain
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()

    def newest(self) -> Iterable[Switch]:
        """What was ordered since the last call."""
        with contextlib.suppress(queue.Empty):
            while True:
                yield self._queue.get_nowait()

    def _read(self, lines: TextIO) -> None:
        for line in lines:
            try:
                self._queue.put(parse_switch(line))
            except UserError as error:
                self._complain(f"error: {error}")


class Server:
    """Runs a mock on a bus until `stop`; every change is told as one line with its time."""

    def __init__(
        self,
        hunter: MockHunter,
        bus: can.BusABC,
        tell: Callable[[str], None] = lambda line: None,
        later: Sequence[tuple[float, str]] = (),
    ) -> None:
        self._hunter, self._bus, self._tell = hunter, bus, tell
        self._later = sorted(later)
        self._ending = threading.Event()
        self._said = ""
        self._fails = False

    def stop(self) -> None:
        """End `run`, from a signal handler or another thread."""
        self._ending.set()

    def run(self, orders: Callable[[], Iterable[Switch]] = tuple) -> None:
        """Obey and report. ``orders`` is asked for switches at every turn."""
        begun_s = time.monotonic()
        while not self._ending.is_set():
            now_s = time.monotonic()
            while self._later and now_s - begun_s >= self._later[0][0]:
                self._switch(self._later.pop(0)[1], True)
            for name, on in orders():
                self._switch(name, on)
            for frame in self._hunter.due(time.monotonic()):
                self._send(frame.can_id, frame.data)
            self._say()
            self._listen()

    def _switch(self, name: str, on: bool) -> None:
        now_s = time.monotonic()
        self._hunter.switch(name, on, now_s)
        self._tell(f"fault t={now_s:.6f} {name}={'on' if on else 'off'}")

    def _listen(self) -> None:
        """Take what comes until the next report is due: one frame, or none."""
        pause_s = max(0.0, self._hunter.next_s - time.monotonic())
        # What a socket cannot unpack is no frame.
        with contextlib.suppress(can.CanError):
            message = self._bus.recv(pause_s)
            if message is not None and _is_plain(message):
                data = bytes(message.data)
                self._hunter.receive(message.arbitration_id, data, time.monotonic())

    def _send(self, can_id: int, data: bytes) -> None:
        frame = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            self._bus.send(frame)
        except can.CanError as error:
            if not self._fails:
                self._tell(f"bus t={time.monotonic():.6f} not sent: {error}")
            self._fails = True
        else:
            self._fails = False

    def _say(self) -> None:
        words = self._hunter.describe()
        if words != self._said:
            self._said = words
            self._tell(f"chassis t={time.monotonic():.6f} {words}")


def _is_plain(message: can.Message) -> bool:
    """Whether it is a data frame with an 11-bit identifier, the only kind that the chassis has."""
    odd = (message.is_extended_id, message.is_remote_frame, message.is_error_frame, message.is_fd)
    return not any(odd)
