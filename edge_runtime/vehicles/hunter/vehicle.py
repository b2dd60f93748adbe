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
from edge_runtime.latency_window import LatencyWindow
from edge_runtime.vehicles.hunter.bus import BusName, Gate, is_bus_off, open_bus
from edge_runtime.vehicles.hunter.core import STOP_TAKES_S, HunterCore
from edge_runtime.vehicles.hunter.frames import MOTION_COMMAND
from edge_runtime.vehicles.hunter.set_point import inner_of
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.hunter.states import State
from edge_runtime.vehicles.interface import ActionLimit, Vehicle, VehicleReport
from edge_runtime.vehicles.similarity import Similarity

assert MOTION_COMMAND.period_s is not None
STREAM_PERIOD_S = MOTION_COMMAND.period_s
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
        self._wake = threading.Event()
        self._stopping = False
        self._closed = False
        self._logged = ""
        self._sent_s: Optional[float] = None
        self._gaps = LatencyWindow()
        self._threads = [
            threading.Thread(target=work, name=f"hunter-{name}", daemon=True)
            for name, work in (("stream", self._stream), ("listener", self._listen))
        ]

    @property
    def state(self) -> State:
        """Where its state machine stands."""
        return self._core.state

    def enable(self, now_s: float) -> None:
        """Ask the chassis for control; `feedback` tells whether it came."""
        with self._lock:
            self._core.enable(now_s)
            self._gate.open()
        self._start()
        self._wake.set()

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
        self._wake.set()

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
        self._wait_for_a_stand()
        self._stopping = True
        self._wake.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(_JOIN_S)
        with self._lock:
            parts = self._core.close(time.monotonic())
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # the chassis stops by itself, and the bus must be freed
            log.event("warning", "hunter_not_parked", detail=error)
        self._bus.shutdown()
        if self._sent_s is not None:
            log.event("info", "hunter_stream", **_rounded(self._gaps.summary_ms()))

    def _start(self) -> None:
        if not self._closed:
            for thread in self._threads:
                if thread.ident is None:
                    thread.start()

    def _wait_for_a_stand(self) -> None:
        end_s = time.monotonic() + STOP_TAKES_S
        while self._threads[0].is_alive() and time.monotonic() < end_s:
            with self._lock:
                if self._core.is_at_rest(time.monotonic()):
                    return
            time.sleep(STREAM_PERIOD_S)

    def _stream(self) -> None:
        next_s = time.monotonic()
        while not self._stopping:
            self._wake.clear()
            self._send_due()
            now_s = time.monotonic()
            if now_s >= next_s:
                # After a pause one frame, not one for each missed period.
                missed = int((now_s - next_s) / STREAM_PERIOD_S)
                next_s += (missed + 1) * STREAM_PERIOD_S
            with self._lock:
                due_s = min(next_s, self._core.late_at_s)
            self._wake.wait(max(0.0, due_s - time.monotonic()))

    def _send_due(self) -> None:
        with self._lock:
            ticked_s = time.monotonic()
            parts = self._core.tick(ticked_s)
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # CanError, OSError, or what else a backend raises
            self._note_bus(error)
            return
        if parts:
            self._note_sent()
        if time.monotonic() - ticked_s > STREAM_PERIOD_S:
            # A process that was stopped in between has said what was asked for before it was. The
            # chassis cannot tell, and may have control again: the next frame does not wait.
            self._wake.set()

    def _note_sent(self) -> None:
        now_s = time.monotonic()
        with self._lock:
            self._core.bus_works()
        if self._sent_s is not None:
            self._gaps.add(int((now_s - self._sent_s) * 1e9))
        self._sent_s = now_s

    def _listen(self) -> None:
        while not self._stopping:
            try:
                message = self._bus.recv(_LISTEN_S)
            except Exception as error:  # as in _send_due; it may raise at once, again and again
                self._note_bus(error)
                time.sleep(STREAM_PERIOD_S)
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
            self._wake.set()

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


def _rounded(summary_ms: Dict[str, float]) -> Dict[str, float]:
    return {f"gap_{name}_ms": round(value, 2) for name, value in summary_ms.items()}
