"""The driver of a Hunter: two threads and a bus around core.py.

- The stream's thread sends what `tick` gives, 50 times a second at absolute deadlines, and at
  once when somebody brakes, no command came in time, or the chassis says what stops it. It is
  the only one that sends, until `close` has joined it.
- The listener's thread hands every frame to `hear`.
Both inherit the priority that `realtime` gave the process.
"""

from __future__ import annotations

import threading
import time
from typing import Any, ClassVar, Dict

from edge_runtime import log
from edge_runtime.vehicles.hunter.bus import BusName, Gate, is_bus_off, open_bus
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.hunter.set_point import limits_of
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.hunter.states import State
from edge_runtime.vehicles.interface import ActionLimit, VehicleReport
from edge_runtime.vehicles.similarity import Similarity
from edge_runtime.vehicles.stream import PERIOD_S
from edge_runtime.vehicles.streamed import StreamedVehicle

_LISTEN_S = 0.1
_JOIN_S = 0.5


class HunterVehicle(StreamedVehicle):
    """Opens its bus when made (UserError where it cannot), and sends nothing before `enable`."""

    name: ClassVar[str] = "hunter"

    def __init__(
        self, bus: BusName, spec: HunterSpec, profile: str, similarity: Similarity
    ) -> None:
        self._bus: Any = open_bus(bus)
        self._gate = Gate(self._bus)
        self._ignores_commands = bus.hears_itself
        self._core: HunterCore
        super().__init__(HunterCore(spec, profile, similarity))
        self.limits: Dict[str, ActionLimit] = limits_of(spec, similarity)
        self._stopping = False
        self._listener = threading.Thread(target=self._listen, name="hunter-listener", daemon=True)

    @property
    def state(self) -> State:
        """Where its state machine stands."""
        return self._core.state

    def enable(self, now_s: float) -> None:
        """Ask the chassis for control; `feedback` tells whether it came. Nothing once closed."""
        if self._closed:
            return
        with self._lock:
            self._core.enable(now_s)
            self._gate.open()
        self._start()
        self._stream.wake()

    def feedback(self, now_s: float) -> VehicleReport:
        """From the newest frames of the chassis, which it listens to before `enable`, too."""
        self._start()
        return super().feedback(now_s)

    def close(self) -> None:
        """Stand, lock the brake, give control back, and leave the bus."""
        if self._closed:
            return
        self._closed = True
        self._end_stream()
        self._stopping = True
        if self._listener.ident is not None:
            self._listener.join(_JOIN_S)
        with self._lock:
            parts = self._core.close(time.monotonic())
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # the chassis stops by itself, and the bus must be freed
            log.event("warning", "hunter_not_parked", detail=error)
        self._bus.shutdown()
        self._log_gaps()

    def _start(self) -> None:
        if self._closed:
            return
        self._stream.start()
        if self._listener.ident is None:
            self._listener.start()

    def _send_due(self) -> bool:
        with self._lock:
            parts = self._core.tick(time.monotonic())
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # CanError, OSError, or what else a backend raises
            self._note_bus(error)
            return False
        if parts:
            with self._lock:
                self._core.bus_works()
        return bool(parts)

    def _listen(self) -> None:
        self._skip_the_past()
        while not self._stopping:
            try:
                message = self._bus.recv(_LISTEN_S)
            except Exception as error:  # as in _send_due; it may raise at once, again and again
                self._note_bus(error)
                time.sleep(PERIOD_S)
                continue
            if message is not None:
                self._hear(message)

    def _skip_the_past(self) -> None:
        """Drop what waited in the bus since it was opened: it would be taken for fresh."""
        end_s = time.monotonic() + PERIOD_S  # of a flood some will be left
        try:
            while time.monotonic() < end_s and self._bus.recv(0.0) is not None:
                pass
        except Exception as error:  # as in _send_due
            self._note_bus(error)

    def _hear(self, message: Any) -> None:
        if message.is_error_frame:
            if is_bus_off(message):
                self._note_bus("bus-off", fatal=True)
            return
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return  # no frame of this protocol
        if self._ignores_commands and self._core.is_command(message.arbitration_id):
            return
        with self._lock:
            was = self._core.state
            self._core.hear(message.arbitration_id, bytes(message.data), time.monotonic())
            stopped = self._core.state is State.STOPPED and was is not State.STOPPED
        if stopped:
            self._stream.wake()

    def _note_bus(self, error: object, fatal: bool = False) -> None:
        words = " ".join(str(error).split()) or type(error).__name__
        with self._lock:
            self._core.bus_failed(words, time.monotonic(), fatal)
