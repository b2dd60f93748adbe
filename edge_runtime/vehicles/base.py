"""What a vehicle driver must do, whether it can be believed, and the thread that runs it.

A driver is called by one thread at a time, and is passed the time as monotonic seconds. The thread
is apart from the control loop: so the feedback goes on when the loop hangs, and shows the vehicle
braking by itself; and the loop goes on, and says safe stop, when the driver raises or hangs.
"""

from __future__ import annotations

import abc
import inspect
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Callable, ClassVar, Mapping, NamedTuple, Optional, Sequence

from edge_runtime import log
from edge_runtime.controller import ActionLimit, Limits
from edge_runtime.manifest import MIN_PERIOD_S
from edge_runtime.util import UserError, ends_within, printable
from edge_runtime.vehicles.plausibility import PEDAL, REASONS, Fault, VehicleWatch
from edge_runtime.wire import FEEDBACK_HZ, MAX_TEXT_CHARS, SAFE_STOP, Command, Feedback

if TYPE_CHECKING:
    from edge_runtime.manifest import Manifest


class VehicleReport(NamedTuple):
    """What the vehicle does. `action` is what its actuators have reached, in the units of `limits`.

    `faults` says in words why it does not drive, until it is enabled again; `standing` are those
    whose cause is there now, so that enabling would be in vain. A vehicle that takes a speed
    instead of a pedal says which one it is asked for (m/s of its own), and what its own speed is
    in the scenario; its pedal is then worked out from its speed.
    """

    action: dict[str, float]
    speed_mps: float
    self_braking: bool
    faults: list[str]
    standing: Sequence[str] = ()
    scenario_speed_mps: Optional[float] = None
    commanded_speed_mps: Optional[float] = None
    battery_v: Optional[float] = None


class Vehicle(abc.ABC):
    """A vehicle under command. `limits` is keyed by the action names of the manifest, in its units.

    `name` is what others see of it, and its table in the settings; the class's own name by default.
    The runtime sets `control_period_s` to the policy's before `enable`; until then it is the
    shortest there is, which brakes soonest.
    """

    name: ClassVar[str]
    limits: Limits
    control_period_s: float = MIN_PERIOD_S

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if not hasattr(cls, "name"):
            cls.name = cls.__name__

    @classmethod
    def open(cls, settings: Mapping[str, Any], manifest: Manifest) -> Vehicle:
        """The driver for a policy, with the settings of its table. Sends nothing before `enable`.

        By default they are the constructor's arguments. Raises UserError for settings that are
        not valid, and where what it hangs on cannot be opened.
        """
        cls._check_names(settings)
        return cls(**settings)

    @classmethod
    def limits_of(cls, settings: Mapping[str, Any], manifest: Manifest) -> dict[str, ActionLimit]:
        """What `limits` of the driver would be, without opening anything: a replay needs them.

        By default those of the class. Raises UserError where it has none, or as `open` does.
        """
        if cls.open.__func__ is Vehicle.open.__func__:  # type: ignore[attr-defined]
            cls._check_names(settings)
        if not hasattr(cls, "limits"):
            raise UserError(f"vehicle {cls.name}: what it lets an action be is not known unopened")
        return cls.limits

    @classmethod
    def _check_names(cls, settings: Mapping[str, Any]) -> None:
        """Raise UserError for settings that are no arguments of the constructor."""
        known = inspect.signature(cls)
        try:
            known.bind(**settings)
        except TypeError as error:
            names = ", ".join(known.parameters) or "none"
            raise UserError(f"settings of {cls.name}: {error}; known are {names}") from None

    @abc.abstractmethod
    def enable(self, now_s: float) -> None:
        """Take control, at the start and again at each re-arm: what stopped it is forgotten.

        Does not wait: until the vehicle confirms, it stands, and `feedback` says how it goes. It
        stands as well until the first command.
        """

    @abc.abstractmethod
    def command(
        self, action: dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Ask for an action; it holds for 2 T, after which the vehicle brakes by itself.

        Raises ValueError for one that lacks what the vehicle needs: it never guesses.

        `scenario_speed_mps` is the speed of the scenario's car: what a policy without a pedal
        has in place of one. Moves nothing while the vehicle is stopped (`brake`, or a fault).
        """

    @abc.abstractmethod
    def brake(self, now_s: float, latch: bool = True) -> None:
        """Full brake at once, steering held; it needs no repetition.

        It moves again only after `enable`; with `latch` False (the end of an episode) already
        with the next command.
        """

    @abc.abstractmethod
    def feedback(self, now_s: float) -> VehicleReport:
        """What the vehicle does now."""

    @abc.abstractmethod
    def close(self) -> None:
        """Brake, give control back and free what the driver holds. Safe to call twice."""


_LEAVE_S = 3.0  # a Hunter that is to stand and give control back takes half of it


def close_in_time(vehicle: Vehicle) -> None:
    """Close a driver that was never enabled; one that hangs is left alone."""
    _note_end(vehicle, ends_within(_LEAVE_S, partial(_end, vehicle, vehicle.close)))


def _note_end(vehicle: Vehicle, ended: bool) -> bool:
    if not ended:
        log.event("error", "driver_hangs", vehicle=vehicle.name, waited_s=_LEAVE_S)
    return ended


def _end(vehicle: Vehicle, *calls: Callable[[], None]) -> None:
    for call in calls:
        try:
            call()
        except BaseException as error:  # the rest must still come to its end
            log.event("error", "driver_not_closed", vehicle=vehicle.name, detail=repr(error))


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
        self.name = vehicle.name
        self._vehicle = vehicle
        self._action_names = action_names
        self._publish = publish
        self.on_fault: Callable[[], None] = lambda: None
        self._watch = VehicleWatch(vehicle.control_period_s, vehicle.limits)
        self._silence_s = 2 * vehicle.control_period_s
        # As often as the topic says, and twice before its silence would be a fault.
        self._period_s = min(1.0 / FEEDBACK_HZ, vehicle.control_period_s / 2)
        self._refuses = False  # the driver raised at the newest command
        self._not_enabled = ""  # why the newest `enable` failed
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
    def silent_at_s(self) -> float:
        """When the vehicle counts as silent if nothing more is heard of it (monotonic)."""
        return self._watch.silent_at_s

    def busy_s(self, now_s: float) -> float:
        """For how long the driver has kept its thread; 0 while that waits. Never waits."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else now_s - since_s

    def fault(self, now_s: float) -> str:
        """What is wrong with the vehicle, empty if nothing. Never waits."""
        with self._due:
            if self._enable_due:
                return self._seen_fault(now_s)
            words = [self._not_enabled, *(self._report_seen.faults if self._report_seen else [])]
        return self._seen_fault(now_s) or next(filter(None, words), "")

    def standing_fault(self, now_s: float) -> str:
        """What enabling the vehicle now would not end, empty if nothing. Never waits."""
        seen = self._report_seen
        return self._seen_fault(now_s) or (seen.standing[0] if seen and seen.standing else "")

    def start(self, armed: bool = True) -> None:
        """Start the vehicle's feedback, and enable it unless that is to wait for an operator.

        Raises UserError where it cannot be enabled.
        """
        self._enable_due = armed
        self._watch.begin(time.monotonic())
        self._thread.start()
        with self._due:
            ended = self._due.wait_for(lambda: not self._enable_due, _LEAVE_S)
        if words := self._not_enabled if ended else f"no end within {_LEAVE_S:g} s":
            raise UserError(f"vehicle {self.name} cannot be enabled: {words}")

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

    def close(self) -> bool:
        """End the feedback; its thread brakes and closes the driver. False where that hangs."""
        with self._due:
            self._stopping = True
            self._due.notify()
        if self._thread.ident is None:  # it was never started, and is closed all the same
            self._thread.start()
        self._thread.join(_LEAVE_S)
        return _note_end(self._vehicle, not self._thread.is_alive())

    def _run(self) -> None:
        next_s = time.monotonic()
        try:
            while not self._stopping:
                next_s = self._live(next_s)
        finally:
            vehicle = self._vehicle
            _end(vehicle, lambda: vehicle.brake(time.monotonic()), vehicle.close)

    def _live(self, next_s: float) -> float:
        """Do what is due, or wait for it; returns when the next report is."""
        enables, task = self._wait(next_s)
        self._busy_since_s = time.monotonic()
        if enables:
            self._enable()
        if task is not None:
            self._obey(task)
        now_s = time.monotonic()
        if now_s >= next_s:
            # Absolute deadlines; after a long pause one report, not one for each missed period.
            next_s = max(next_s + self._period_s, now_s)
            self._report()
        self._busy_since_s = None
        return next_s

    def _wait(self, until_s: float) -> tuple[bool, Optional[_Task]]:
        """Whether to enable, and then the newest command; as soon as there is one, or at a time."""
        with self._due:
            self._due.wait_for(
                lambda: self._next is not None or self._enable_due or self._stopping,
                max(0.0, until_s - time.monotonic()),
            )
            task, self._next = self._next, None
            return self._enable_due, task

    def _enable(self) -> None:
        self._take_control(time.monotonic())
        if not self._not_enabled:
            self._ask()
        with self._due:
            self._enable_due = False
            self._due.notify()
        if self._not_enabled:
            self.on_fault()

    def _take_control(self, now_s: float) -> None:
        try:
            self._watch.enable(now_s)
            self._vehicle.enable(now_s)
            self._not_enabled = ""
        except BaseException as error:
            self._not_enabled = printable(str(error) or type(error).__name__)
            log.event("error", "not_enabled", detail=self._not_enabled)

    def _obey(self, task: _Task) -> None:
        """Ask the driver. A safe stop's mode alone means brake."""
        self._last = command = task.command
        now_s = time.monotonic()
        action = dict(zip(self._action_names, command.action))
        self._watch.command(action, now_s)
        if command.mode == SAFE_STOP:  # It brakes, whatever number is the policy's stop.
            self._watch.command({**action, PEDAL: -1.0}, now_s, drives=False)
        try:
            if command.mode == SAFE_STOP:
                self._vehicle.brake(now_s, task.latch)
            elif len(command.action) != len(self._action_names):
                raise ValueError(f"a command of {command.action} for {self._action_names}")
            elif self._not_enabled:
                return  # that is the fault
            elif now_s - task.given_s <= self._silence_s:  # One that hung must not obey the past.
                self._vehicle.command(action, now_s, task.scenario_speed_mps)
        except BaseException as error:
            if not self._refuses:
                log.event("error", "not_obeyed", detail=error)
            self._refuses = True
            self.on_fault()
            return
        self._refuses = False

    def _report(self) -> None:
        report, last = self._ask(), self._last
        fault = self.fault(time.monotonic())
        if fault:
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
        return REASONS[fault] if fault else ""

    def _ask(self) -> Optional[VehicleReport]:
        """The vehicle's report; None where the driver fails, which is silence like any other."""
        try:
            report = _plain(self._vehicle.feedback(time.monotonic()), self._action_names)
            self._watch.report(report, time.monotonic())
        except BaseException as error:
            if not self._failing:
                log.event("error", "no_feedback", detail=error)
            self._failing = True
            return None
        self._failing = False
        self._report_seen = report
        return report


def _plain(report: VehicleReport, names: Sequence[str]) -> VehicleReport:
    """In Python's own types: a driver's numbers may be numpy's.

    Raises for what is no report, and for one that leaves out an action of these names: nobody could
    see whether it obeys.
    """
    more = (None if value is None else float(value) for value in report[5:])
    action = {name: float(value) for name, value in report.action.items()}
    if lacking := [name for name in names if name not in action]:
        raise ValueError(f"feedback without {', '.join(lacking)}")
    said = (report.faults, report.standing)
    faults, standing = ([printable(str(words)) for words in each] for each in said)
    speed_mps, braking = float(report.speed_mps), bool(report.self_braking)
    return VehicleReport(action, speed_mps, braking, faults, standing, *more)
