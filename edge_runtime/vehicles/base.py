"""The contract of a vehicle driver, and the thread that runs one.

One thread at a time calls a driver, and passes it the time in monotonic seconds. This thread is
not the control loop's: if either hangs, the other still stops the vehicle.
"""

from __future__ import annotations

import abc
import threading
import time
from functools import partial
from typing import Any, Callable, ClassVar, Mapping, NamedTuple, Optional, Sequence, Tuple

from edge_runtime import log
from edge_runtime.bounds import NO_BOUNDS, Bounds, Leash, Model, check_bounds, narrowed
from edge_runtime.controller import Limits
from edge_runtime.manifest import MIN_PERIOD_S, Manifest
from edge_runtime.util import UserError, ends_within, printable
from edge_runtime.vehicles.plausibility import PEDAL, Fault, VehicleReport, VehicleWatch
from edge_runtime.wire import FEEDBACK_HZ, MAX_TEXT_CHARS, SAFE_STOP, Command, Feedback


class Vehicle(abc.ABC):
    """A vehicle under command. `limits` is keyed by the action names of the manifest, in its units.

    `name` is shown to others and names the table in the settings; by default the class's name. The
    runtime sets `control_period_s` to the policy's before `enable`. A driver must drive no faster
    than `allowed.max_speed_mps`, or the runtime stops it; the runtime holds the other bounds.

    For `jog`: `outranked_by` maps "remote_control" and "emergency_stop" to their words in a
    report's `standing`; `steers_at_a_stand` is False if reports have no angle at a stand.
    """

    name: ClassVar[str]
    limits: Limits
    model_limits: Model = Model()
    allowed: Bounds = NO_BOUNDS
    outranked_by: ClassVar[Mapping[str, str]] = {}
    steers_at_a_stand: bool = True
    control_period_s: float = MIN_PERIOD_S

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if not hasattr(cls, "name"):
            cls.name = cls.__name__

    @classmethod
    def open(cls, settings: Mapping[str, Any], manifest: Manifest) -> Vehicle:
        """Make the driver for a policy; send nothing. By default the settings are its arguments.

        Raises UserError for settings that are not valid, and where a port cannot be opened.
        """
        return cls(**settings)

    @classmethod
    def limits_of(cls, settings: Mapping[str, Any], manifest: Manifest) -> Tuple[Limits, Model]:
        """Return `limits` and `model_limits` of the driver to be, by default the class's."""
        return cls.limits, cls.model_limits

    @property
    def allowed_limits(self) -> Limits:
        """`limits`, cut to the operator's bounds."""
        return narrowed(self.limits, self.allowed, self.model_limits)

    def take_bounds(self, bounds: Bounds) -> None:
        """Take the operator's bounds, before `enable`. UserError for one above the model's."""
        check_bounds(bounds, self.model_limits, self.name)
        self.allowed = bounds

    @abc.abstractmethod
    def enable(self, now_s: float) -> None:
        """Take control, at the start and at each re-arm; forget the last stop. Must not block.

        The vehicle stands until it confirms (in `feedback`), and until the first command.
        """

    @abc.abstractmethod
    def command(
        self, action: dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Ask for an action, which holds for 2 T; then the vehicle brakes by itself.

        `scenario_speed_mps` is the speed of the scenario's car, for a policy without a pedal.
        Moves nothing while the vehicle is stopped (`brake`, or a fault). Raises ValueError for an
        action that lacks what the vehicle needs: a driver never guesses.
        """

    @abc.abstractmethod
    def brake(self, now_s: float, latch: bool = True) -> None:
        """Brake fully at once with the steering held; it needs no repetition.

        The vehicle moves again after `enable`; with `latch` False (the end of an episode) already
        with the next command.
        """

    def mute(self) -> None:  # noqa: B027 (most drivers need none)
        """Send the vehicle nothing until `brake` or `close`, as if the process had died.

        For `jog` alone, where a driver sends by itself.
        """

    @abc.abstractmethod
    def feedback(self, now_s: float) -> VehicleReport:
        """Report what the vehicle does now."""

    @abc.abstractmethod
    def close(self) -> None:
        """Brake, give control back and free what the driver holds. Safe to call twice."""


_LEAVE_S = 3.0  # a Hunter takes half of it to stop and give control back


def close_in_time(vehicle: Vehicle) -> None:
    """Close a driver that was never enabled; one that hangs is left alone."""
    if not ends_within(_LEAVE_S, partial(_end, vehicle, vehicle.close)):
        log.event("error", "driver_hangs", vehicle=vehicle.name)


def _end(vehicle: Vehicle, *calls: Callable[[], None]) -> None:
    for call in calls:
        try:
            call()
        except BaseException as error:  # the other calls must still be made
            log.event("error", "driver_not_closed", vehicle=vehicle.name, detail=repr(error))


class _Order(NamedTuple):
    command: Command
    scenario_speed_mps: Optional[float]
    latch: bool
    given_s: float


class VehicleRunner:
    """Calls the vehicle from a thread of its own. Only `start` and `close` wait for that thread.

    `action_names` are the policy's, in the order of a command's action.
    """

    def __init__(
        self, vehicle: Vehicle, action_names: Sequence[str], publish: Callable[[Feedback], None]
    ) -> None:
        self.name = vehicle.name
        self.on_fault: Callable[[], None] = lambda: None
        self._vehicle, self._action_names, self._publish = vehicle, action_names, publish
        self.allowed = vehicle.allowed
        self._limits = vehicle.allowed_limits
        self.leash = Leash(vehicle.allowed.leash_m)
        self._watch = VehicleWatch(
            vehicle.control_period_s, vehicle.limits, vehicle.allowed.max_speed_mps
        )
        # At the topic's rate, and at least twice before silence is a fault.
        self._period_s = min(1.0 / FEEDBACK_HZ, vehicle.control_period_s / 2)
        self._refuses = self._fails = False  # the driver raised at the newest command, report
        self._not_enabled = ""  # why the newest `enable` failed
        self._next: Optional[_Order] = None  # the newest, until the driver takes it
        self._last: Optional[Command] = None
        self._heard: Optional[VehicleReport] = None
        self._enable_due = self._stopping = False
        self._busy_since_s: Optional[float] = None  # its thread is in the driver
        self._due = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    @property
    def silent_at_s(self) -> float:
        """When the vehicle counts as silent if nothing more is heard of it (monotonic)."""
        return self._watch.silent_at_s

    @property
    def leash_is_used(self) -> bool:
        """Whether the leash is used up, or will be before the next report."""
        return not self._enable_due and self.leash.is_used(self._period_s)

    def busy_s(self, now_s: float) -> float:
        """Return for how long the driver has kept its thread; 0 while that waits."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else now_s - since_s

    def fault(self, now_s: float) -> str:
        """Return what is wrong with the vehicle, empty if nothing."""
        with self._due:
            words = [self._not_enabled, *(self._heard.faults if self._heard else [])]
            if self._enable_due:  # its old faults no longer count
                words = []
        return self._seen_fault(now_s) or next(filter(None, words), "")

    def standing_fault(self, now_s: float) -> str:
        """Return the fault that enabling the vehicle now would not end, empty if none."""
        heard = self._heard
        return self._seen_fault(now_s) or (heard.standing[0] if heard and heard.standing else "")

    def start(self, armed: bool = True) -> None:
        """Start the feedback, and enable the vehicle where `armed`; UserError where that fails."""
        self._enable_due = armed
        self._watch.begin(time.monotonic())
        self._thread.start()
        with self._due:
            ended = self._due.wait_for(lambda: not self._enable_due, _LEAVE_S)
        if words := self._not_enabled if ended else f"no end within {_LEAVE_S:g} s":
            raise UserError(f"vehicle {self.name} cannot be enabled: {words}")

    def enable(self) -> None:
        """Enable the vehicle again, after a re-arm; drop a stop that still waits."""
        with self._due:
            self._enable_due, self._next = True, None
            self._due.notify()

    def command(
        self, command: Command, scenario_speed_mps: Optional[float] = None, latch: bool = True
    ) -> None:
        """Pass on a command, in place of one that still waits. `latch`: as in `Vehicle.brake`."""
        with self._due:
            self._next = _Order(command, scenario_speed_mps, latch, time.monotonic())
            self._due.notify()

    def close(self) -> bool:
        """End the feedback; its thread brakes and closes the driver. False where that hangs."""
        with self._due:
            self._stopping = True
            self._due.notify()
        if self._thread.ident is None:  # never started: started now, to close the driver
            self._thread.start()
        self._thread.join(_LEAVE_S)
        if hangs := self._thread.is_alive():
            log.event("error", "driver_hangs", vehicle=self.name)
        return not hangs

    def _run(self) -> None:
        next_s, vehicle = time.monotonic(), self._vehicle  # of the next report
        try:
            while not self._stopping:
                with self._due:
                    self._due.wait_for(self._has_work, max(0.0, next_s - time.monotonic()))
                    enables, order, self._next = self._enable_due, self._next, None
                self._busy_since_s = time.monotonic()
                if enables:
                    self._enable()
                if order is not None:
                    self._obey(order)
                now_s = time.monotonic()
                if now_s >= next_s:
                    # Absolute deadlines; after a pause one report, not one for each missed period.
                    next_s = max(next_s + self._period_s, now_s)
                    self._report()
                self._busy_since_s = None
        finally:
            _end(vehicle, lambda: vehicle.brake(time.monotonic()), vehicle.close)

    def _has_work(self) -> bool:
        return self._next is not None or self._enable_due or self._stopping

    def _enable(self) -> None:
        now_s = time.monotonic()
        self._watch.enable(now_s)
        self.leash.begin()
        try:
            self._vehicle.enable(now_s)
            self._not_enabled = ""
            self._ask()  # before its faults count again
        except BaseException as error:
            self._not_enabled = printable(str(error) or type(error).__name__)
            log.event("error", "not_enabled", detail=self._not_enabled)
        with self._due:
            self._enable_due = False
            self._due.notify()
        if self._not_enabled:
            self.on_fault()

    def _obey(self, order: _Order) -> None:
        """Command the driver. The mode alone makes a safe stop, whatever the action's numbers."""
        self._last = command = order.command
        now_s, vehicle = time.monotonic(), self._vehicle
        action = self._bounded(dict(zip(self._action_names, command.action)))
        self._watch.command(action, now_s, command.mode != SAFE_STOP)
        try:
            if command.mode == SAFE_STOP:
                vehicle.brake(now_s, order.latch)
            elif len(command.action) != len(self._action_names):
                raise ValueError(f"a command of {command.action} for {self._action_names}")
            elif self._not_enabled:
                return  # `fault` reports it
            elif now_s - order.given_s <= 2 * vehicle.control_period_s:  # old after a hang
                vehicle.command(action, now_s, order.scenario_speed_mps)
        except BaseException as error:
            if not self._refuses:
                log.event("error", "not_obeyed", detail=error)
            self._refuses = True
            self.on_fault()
            return
        self._refuses = False

    def _bounded(self, action: dict[str, float]) -> dict[str, float]:
        """Cut an action to the operator's bounds: at the speed cap there is no more throttle."""
        for name, limit in self._limits.items():
            if name in action:
                action[name] = min(max(action[name], limit.low), limit.high)
        heard_mps = self._heard.speed_mps if self._heard else 0.0
        if PEDAL in action and heard_mps >= self.allowed.max_speed_mps:
            action[PEDAL] = min(action[PEDAL], 0.0)
        return action

    def _report(self) -> None:
        report, last = self._ask(), self._last
        fault = self.fault(time.monotonic())
        if fault or self.leash_is_used:
            self.on_fault()
        if report is None:
            return
        faults = [*report.faults, fault] if fault and fault not in report.faults else report.faults
        self._publish(
            Feedback(
                vehicle=self.name,
                session=last.session if last else "",
                episode=last.episode if last else -1,
                step=last.step if last else -1,
                mode=last.mode if last else "standby",
                action=[report.action[name] for name in self._action_names],
                speed_mps=report.speed_mps,
                self_braking=report.self_braking,
                faults=[text[:MAX_TEXT_CHARS] for text in faults],
                sent_ns=time.time_ns(),
                scenario_speed_mps=report.scenario_speed_mps,
                commanded_speed_mps=report.commanded_speed_mps,
                battery_v=report.battery_v,
            )
        )

    def _seen_fault(self, now_s: float) -> str:
        fault = Fault.SILENT if self._refuses else self._watch.fault(now_s)
        return fault.value if fault else ""

    def _ask(self) -> Optional[VehicleReport]:
        """Return the vehicle's report; None where the driver fails, which counts as silence."""
        try:
            report = _plain(self._vehicle.feedback(time.monotonic()), self._action_names)
            self._watch.report(report, time.monotonic())
            # Odometry may read too low: the commanded speed is a second source.
            most_mps = max(abs(report.speed_mps), abs(report.commanded_speed_mps or 0.0))
            self.leash.note(most_mps, time.monotonic())
        except BaseException as error:
            if not self._fails:
                log.event("error", "no_feedback", detail=error)
            self._fails = True
            return None
        self._fails, self._heard = False, report
        return report


def _plain(report: VehicleReport, names: Sequence[str]) -> VehicleReport:
    """Convert a report to Python's own types; raise if it is none, or lacks one of `names`."""
    action = {name: float(value) for name, value in report.action.items()}
    if lacking := [name for name in names if name not in action]:
        raise ValueError(f"feedback without {', '.join(lacking)}")
    lists = (report.faults, report.standing)
    faults, standing = ([printable(str(words)) for words in each] for each in lists)
    more = (None if value is None else float(value) for value in report[5:])
    speed_mps, braking = float(report.speed_mps), bool(report.self_braking)
    return VehicleReport(action, speed_mps, braking, faults, standing, *more)
