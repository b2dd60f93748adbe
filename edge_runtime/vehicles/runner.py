"""Gives a vehicle its commands and publishes its feedback, from a thread of its own.

So the feedback goes on when the control loop hangs, and shows the vehicle braking by itself; and
the control loop goes on, and says safe stop, when the driver raises or hangs.
"""

from __future__ import annotations

import threading
import time
from typing import Callable, List, NamedTuple, Optional, Sequence, Tuple

from edge_runtime import log
from edge_runtime.vehicles.interface import Vehicle, VehicleReport
from edge_runtime.vehicles.watch import SILENCE_S, SILENT, VehicleWatch
from edge_runtime.wire import MAX_TEXT_CHARS, SAFE_STOP, TOPICS, Command, Feedback

_PERIOD_S = 1.0 / TOPICS["feedback"].rate_hz
_JOIN_S = 0.5


class _Task(NamedTuple):
    """A command, and what the vehicle needs besides."""

    command: Command
    scenario_speed_mps: Optional[float]
    latch: bool
    given_s: float


class VehicleRunner:
    """Owns the vehicle: once started, its own thread alone calls it until `close`.

    `action_names` are the policy's, in the order of a command's action.
    """

    def __init__(
        self, vehicle: Vehicle, action_names: Sequence[str], publish: Callable[[Feedback], None]
    ) -> None:
        self._vehicle = vehicle
        self._action_names = action_names
        self._publish = publish
        self.on_fault: Callable[[], None] = lambda: None
        self._watch = VehicleWatch()
        self._refuses = False  # the driver raised at the newest command
        self._failing = False
        self._next: Optional[_Task] = None  # the newest, until the driver takes it
        self._last: Optional[Command] = None
        self._report_seen: Optional[VehicleReport] = None
        self._enable_due = False
        self._stopping = False
        self._busy_since_s: Optional[float] = None  # its thread is in the driver
        self._due = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    @property
    def name(self) -> str:
        """The vehicle's, as `--vehicle` knows it."""
        return self._vehicle.name

    @property
    def silent_at_s(self) -> float:
        """When the vehicle counts as silent if nothing more is heard of it (monotonic)."""
        return self._watch.silent_at_s

    def busy_s(self, now_s: float) -> float:
        """For how long the driver has kept its thread; 0 while that waits. Waits for nobody."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else now_s - since_s

    def fault(self, now_s: float) -> str:
        """What is wrong with the vehicle, empty if nothing. Waits for nobody."""
        with self._due:
            if self._enable_due:
                return self._seen_fault(now_s)
        seen = self._report_seen
        return self._seen_fault(now_s) or (seen.faults[0] if seen and seen.faults else "")

    def standing_fault(self, now_s: float) -> str:
        """What enabling the vehicle now would not end, empty if nothing. Waits for nobody."""
        seen = self._report_seen
        return self._seen_fault(now_s) or (seen.standing[0] if seen and seen.standing else "")

    def start(self, armed: bool = True) -> None:
        """Start the vehicle's feedback, and enable it unless that is to wait for an operator."""
        now_s = time.monotonic()
        if armed:
            self._vehicle.enable(now_s)
        self._watch.begin(now_s)
        self._thread.start()

    def enable(self) -> None:
        """Have the vehicle enabled again: an operator has re-armed it. Never waits.

        Its old faults no longer count; a command that is still on its way is dropped, because a
        stop from before would undo it.
        """
        with self._due:
            self._enable_due, self._next = True, None
            self._due.notify()

    def command(
        self, command: Command, scenario_speed_mps: Optional[float] = None, latch: bool = True
    ) -> None:
        """Hand on a command, in place of one that the driver has not taken yet. Never waits.

        `scenario_speed_mps` is that of the state it answers. A safe stop with `latch` False may
        be followed by a drive without `enable`.
        """
        with self._due:
            self._next = _Task(command, scenario_speed_mps, latch, time.monotonic())
            self._due.notify()

    def close(self) -> None:
        """Brake, end the feedback, close the driver; one that hangs is left alone."""
        with self._due:
            self._stopping = True
            self._due.notify()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        if self._thread.is_alive():
            log.event("error", "driver_hangs", vehicle=self.name)
            return
        for end in (lambda: self._vehicle.brake(time.monotonic()), self._vehicle.close):
            try:
                end()
            except Exception as error:  # the rest of the runtime must still come to its end
                log.event("error", "driver_not_closed", detail=error)

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping:
            enables, task = self._wait(next_s)
            self._busy_since_s = time.monotonic()
            if enables:
                self._enable()
            if task is not None:
                self._obey(task)
            now_s = time.monotonic()
            if now_s >= next_s:
                # Absolute deadlines; after a long pause one report, not one for each missed period.
                next_s = max(next_s + _PERIOD_S, now_s)
                self._report()
            self._busy_since_s = None

    def _wait(self, until_s: float) -> Tuple[bool, Optional[_Task]]:
        """Whether to enable, and then the newest command; as soon as there is one, or at a time."""
        with self._due:
            pause_s = max(0.0, until_s - time.monotonic())
            self._due.wait_for(
                lambda: self._next is not None or self._enable_due or self._stopping, pause_s
            )
            task, self._next = self._next, None
            return self._enable_due, task

    def _enable(self) -> None:
        try:
            self._vehicle.enable(time.monotonic())
        except Exception as error:  # as in _obey; its report goes on saying what is wrong
            log.event("error", "not_enabled", detail=error)
        else:
            self._ask()
        with self._due:
            self._enable_due = False

    def _obey(self, task: _Task) -> None:
        """Ask the driver. A safe stop's mode alone means brake."""
        self._last = command = task.command
        now_s = time.monotonic()
        action = dict(zip(self._action_names, command.action))
        self._watch.command(action, now_s)
        try:
            if command.mode == SAFE_STOP:
                self._vehicle.brake(now_s, task.latch)
            elif len(command.action) != len(self._action_names):
                raise ValueError(f"a command of {command.action} for {self._action_names}")
            elif now_s - task.given_s <= SILENCE_S:  # a driver that hung must not obey the past
                self._vehicle.command(action, now_s, task.scenario_speed_mps)
        except Exception as error:  # a driver may raise anything; its thread must live on
            if not self._refuses:
                log.event("error", "not_obeyed", detail=error)
            self._refuses = True
            self.on_fault()
            return
        self._refuses = False

    def _report(self) -> None:
        report = self._ask()
        fault = self.fault(time.monotonic())
        if fault:
            self.on_fault()
        if report is not None:
            self._publish(self._feedback(report, self._last, fault))

    def _seen_fault(self, now_s: float) -> str:
        return SILENT if self._refuses else self._watch.fault(now_s)

    def _ask(self) -> Optional[VehicleReport]:
        """The vehicle's report; None where the driver fails, which is silence like any other."""
        try:
            report = self._vehicle.feedback(time.monotonic())
        except Exception as error:  # as in _obey
            if not self._failing:
                log.event("error", "no_feedback", detail=error)
            self._failing = True
            return None
        self._failing = False
        self._report_seen = report
        self._watch.report(report, time.monotonic())
        return report

    def _feedback(self, report: VehicleReport, last: Optional[Command], fault: str) -> Feedback:
        return Feedback(
            vehicle=self._vehicle.name,
            session=last.session if last else "",
            episode=last.episode if last else -1,
            step=last.step if last else -1,
            mode=last.mode if last else "standby",
            action=[report.action.get(name, 0.0) for name in self._action_names],
            speed_mps=report.speed_mps,
            self_braking=report.self_braking,
            faults=_texts(report.faults, fault),
            sent_ns=time.time_ns(),
            scenario_speed_mps=report.scenario_speed_mps,
            commanded_speed_mps=report.commanded_speed_mps,
            battery_v=report.battery_v,
        )


def _texts(faults: Sequence[str], fault: str) -> List[str]:
    """All faults once, none longer than the wire takes."""
    every = [*faults, fault] if fault and fault not in faults else faults
    return [text[:MAX_TEXT_CHARS] for text in every]
