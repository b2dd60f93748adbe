"""The shell of a vehicle that must hear from us 50 times a second: a thread, a lock, and its core.

The stream sends what the core (core.py) asks for, and a lock is around every call of the core.
The bus or network is called outside of the lock, so that no caller waits for it. A chassis takes a
stream that pauses for a lost link: the deadlines are absolute, and the thread does nothing else. It
inherits the priority that the runtime gave the process.
"""

from __future__ import annotations

import abc
import inspect
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, ClassVar, Dict, Mapping, Optional, Type

from edge_runtime import log
from edge_runtime.config import convert
from edge_runtime.controller import Limits
from edge_runtime.vehicles.base import Vehicle, VehicleReport
from edge_runtime.vehicles.core import STOP_TAKES_S, StreamedCore, VehicleState
from edge_runtime.vehicles.mapping import RobotSettings

if TYPE_CHECKING:
    from edge_runtime.manifest import Manifest

PERIOD_S = 0.02
_JOIN_S = 0.5


class StreamedVehicle(Vehicle):
    """A core behind a lock, and the stream that sends what it asks for.

    A driver is made of its settings and the similarity of its robot to the policy's car. It starts
    the stream at the end of `__init__`: nothing leaves before `enable`.
    """

    settings_type: ClassVar[Type[RobotSettings]]

    def __init__(self, core: StreamedCore) -> None:
        self._core = core
        self.limits = core.similarity.limits()
        self._lock = threading.Lock()
        self._closed = False
        self._logged = ("", "")
        self._stream = Stream(f"{self.name}-stream", self._send_due, self._late_at_s)

    @classmethod
    def arguments_of(
        cls, settings: Mapping[str, Any], manifest: Manifest
    ) -> inspect.BoundArguments:
        given = convert(settings, cls.settings_type, f"vehicle.{cls.name}")
        return inspect.signature(cls).bind(given, given.similarity(cls.name, manifest))

    @classmethod
    def limits_of(cls, settings: Mapping[str, Any], manifest: Manifest) -> Limits:
        _, similarity = cls.arguments_of(settings, manifest).args
        limits: Limits = similarity.limits()
        return limits

    @property
    def state(self) -> VehicleState:
        return self._core.state

    def enable(self, now_s: float) -> None:
        """Ask for control; `feedback` tells whether it came. Does nothing once closed."""
        if self._closed:
            return
        with self._lock:
            self._core.follow_period(self.control_period_s)
            self._core.enable(now_s)
        self._stream.wake()

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Take a pedal or the speed of the scenario's car, and a steering, which else stays."""
        with self._lock:
            self._core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Send speed 0 at once, not with the next period."""
        with self._lock:
            self._core.brake(now_s, latch)
        self._stream.wake()

    def feedback(self, now_s: float) -> VehicleReport:
        with self._lock:
            self._core.follow_period(self.control_period_s)  # it listens before it is enabled
            report = self._core.report(now_s)
            state, words = self._core.state.value, self._core.words
        if (state, words) != self._logged:  # here, because the stream's thread must not wait
            self._logged = (state, words)
            log.event("warning" if words else "info", self.name, state=state, why=words)
        return report

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self.brake(time.monotonic())
        self._stream.run_until(self._is_at_rest, STOP_TAKES_S)
        self._stream.stop()
        self._leave()

    @abc.abstractmethod
    def _send_due(self) -> bool:
        """Send what the core's `tick` gives; return whether anything was. Never raises."""

    @abc.abstractmethod
    def _leave(self) -> None:
        """Give control back, and free what is held; the stream has ended."""

    def _is_at_rest(self) -> bool:
        with self._lock:
            return self._core.is_at_rest(time.monotonic())

    def _late_at_s(self) -> float:
        with self._lock:
            return self._core.late_at_s


class Stream:
    """A thread around `send`, which tells whether anything was sent and never raises.

    `late_at_s` says when the newest command becomes too old (monotonic; inf where there is none):
    the stop does not wait for the next period. Both are called without any lock held.
    """

    def __init__(self, name: str, send: Callable[[], bool], late_at_s: Callable[[], float]) -> None:
        self._send, self._late_at_s = send, late_at_s
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wake(self) -> None:
        """Send now: somebody brakes."""
        self._wake.set()

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> None:
        """Go on streaming until the condition holds, no longer than the limit."""
        end_s = time.monotonic() + limit_s
        while self._thread.is_alive() and time.monotonic() < end_s and not condition():
            time.sleep(PERIOD_S)

    def stop(self) -> None:
        """End the thread; one that hangs in `send` is left alone."""
        self._stopping = True
        self._wake.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping:
            self._wake.clear()
            began_s = time.monotonic()
            sent = self._send()
            now_s = time.monotonic()
            if sent and now_s - began_s > PERIOD_S:
                # A process that was stopped in between has sent what was asked for before.
                # The vehicle cannot tell, and may have control again: the next does not wait.
                self._wake.set()
            if now_s >= next_s:
                # After a pause one sending, not one for each missed period.
                next_s += (int((now_s - next_s) / PERIOD_S) + 1) * PERIOD_S
            self._wake.wait(max(0.0, min(next_s, self._late_at_s()) - time.monotonic()))
