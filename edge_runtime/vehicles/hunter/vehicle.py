"""The driver of a Hunter: two threads and a bus around core.py.

- The stream's thread sends what `tick` gives, 50 times a second at absolute deadlines, and at
  once when somebody brakes, no command came in time, or the chassis says what stops it. It is
  the only one that sends, until `close` has joined it.
- The listener's thread hands every frame to `hear`.
Both inherit the priority that `realtime` gave the process. All calls of the core hold one lock;
the bus is called outside of it, so that nobody waits for a bus.
"""

from __future__ import annotations

import threading
import time
from typing import Any, ClassVar, Dict, Optional

from edge_runtime import log
from edge_runtime.vehicles.hunter.bus import BusName, Gate, is_bus_off, open_bus
from edge_runtime.vehicles.hunter.core import STOP_TAKES_S, HunterCore
from edge_runtime.vehicles.hunter.set_point import inner_of
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.hunter.states import State
from edge_runtime.vehicles.interface import ActionLimit, Vehicle, VehicleReport
from edge_runtime.vehicles.similarity import Similarity
from edge_runtime.vehicles.stream import PERIOD_S, Stream

_LISTEN_S = 0.1
_JOIN_S = 0.5
# A pedal is integrated to a speed, so that any leap of it is a ramp: 2.0 in T = 0.1 s.
_PEDAL_SLEW_PER_S = 20.0


class HunterVehicle(Vehicle):
    """Opens its bus when made (UserError where it cannot), and sends nothing before `enable`."""

    name: ClassVar[str] = "hunter"

    def __init__(
        self, bus: BusName, spec: HunterSpec, profile: str, similarity: Similarity
    ) -> None:
        self._bus: Any = open_bus(bus)
        self._gate = Gate(self._bus)
        self._ignores_commands = bus.hears_itself
        self._core = HunterCore(spec, profile, similarity)
        self.limits: Dict[str, ActionLimit] = _limits(spec, similarity)
        self._lock = threading.Lock()
        self._closed = False
        self._stopping = False
        self._logged = ""
        self._stream = Stream("hunter-stream", self._send_due, self._late_at_s)
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

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """A pedal, or the speed of the scenario's car; and a steering, which else stays."""
        with self._lock:
            self._core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Speed 0 leaves at once, not with the next period."""
        with self._lock:
            self._core.brake(now_s, latch)
        self._stream.wake()

    def feedback(self, now_s: float) -> VehicleReport:
        """From the newest frames of the chassis, which it listens to before `enable`, too."""
        self._start()
        with self._lock:
            report = self._core.report(now_s)
            self._log_state()
        return report

    def close(self) -> None:
        """Stand, lock the brake, give control back, and leave the bus."""
        if self._closed:
            return
        self._closed = True
        self.brake(time.monotonic())
        self._stream.run_until(self._is_at_rest, STOP_TAKES_S)
        self._stream.stop()
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
        gaps_ms = self._stream.gaps_ms()
        if gaps_ms:
            log.event("info", "hunter_stream", **gaps_ms)

    def _start(self) -> None:
        if self._closed:
            return
        self._stream.start()
        if self._listener.ident is None:
            self._listener.start()

    def _is_at_rest(self) -> bool:
        with self._lock:
            return self._core.is_at_rest(time.monotonic())

    def _late_at_s(self) -> float:
        with self._lock:
            return self._core.late_at_s

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
        while not self._stopping:
            try:
                message = self._bus.recv(_LISTEN_S)
            except Exception as error:  # as in _send_due; it may raise at once, again and again
                self._note_bus(error)
                time.sleep(PERIOD_S)
                continue
            if message is not None:
                self._hear(message)

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

    def _log_state(self) -> None:
        """Each state once, when feedback is asked for: never from the stream's thread."""
        core = self._core
        line = f"{core.state.value} {core.words}".strip()
        if line != self._logged:
            self._logged = line
            is_bad = core.state is State.STOPPED and bool(core.words)
            log.event(
                "warning" if is_bad else "info", "hunter", state=core.state.value, why=core.words
            )


def _limits(spec: HunterSpec, similarity: Similarity) -> Dict[str, ActionLimit]:
    full_rad = abs(inner_of(1.0, spec, similarity))
    return {
        "pedal": ActionLimit(-1.0, 1.0, _PEDAL_SLEW_PER_S),
        "steering": ActionLimit(-1.0, 1.0, spec.max_steering_rate_radps / full_rad),
    }
