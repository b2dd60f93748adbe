"""The driver of a vehicle that needs a command 50 times a second: a pure core and its shell.

`StreamedCore` decides, by a state machine (LEADS_TO). It is pure: `StreamedVehicle` serialises the
calls, passes monotonic seconds, and sends what `tick` returns.

STOPPED is a latch of our own, and only ENABLE leads out: a chassis takes commands again by itself,
when they resume, when the remote control lets go, or when an error passes.
"""

from __future__ import annotations

import abc
import math
import threading
import time
from collections import deque
from enum import Enum
from typing import Any, ClassVar, Deque, Dict, List, Mapping, Optional, Tuple, Type

from edge_runtime import log
from edge_runtime.bounds import Bounds, Model
from edge_runtime.config import convert
from edge_runtime.controller import Limits
from edge_runtime.manifest import MIN_PERIOD_S, Manifest
from edge_runtime.safety import SILENCE_PERIODS
from edge_runtime.vehicles.base import Vehicle, VehicleReport
from edge_runtime.vehicles.mapping import RobotSettings, SetPoint, Similarity, Wish, clamp, wish_of
from edge_runtime.vehicles.plausibility import ENABLE_TIMEOUT_S, DriveWatch, Fault, Finding

PERIOD_S = 0.02
# One period later than the runtime's own silence rule, so that the runtime names the reason.
BEAT_S = 0.02
LEAST_SILENCE_S = 0.06  # three reports of a vehicle that sends fifty a second
# At the end zeros are sent for this long, or until the vehicle is known to stand. If it is not
# known to stand by then, the parking brake is locked, where there is one.
STOP_TAKES_S = 1.0
STANDS_MPS = 0.02
_WINDOW_S = 0.11
_JOIN_S = 0.5


class VehicleState(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class VehicleEvent(str, Enum):
    """What can happen, besides a `Fault`."""

    ENABLE = "enable"
    BRAKE = "brake"
    CLOSE = "close"
    CONFIRMED = "confirmed"  # CAN control, brake released, no error; or fresh odometry
    NOT_CONFIRMED = "not_confirmed"  # within ENABLE_TIMEOUT_S
    COMMAND_LATE = "command_late"  # no fresh command for `command_timeout_s`
    REMOTE = "remote_control"
    ESTOP = "emergency_stop"
    STANDBY = "chassis_standby"  # or another mode that is not CAN control
    LOCKED = "brake_locked"
    FAULT = "chassis_fault"
    BUS = "bus_error"
    FOREIGN = "foreign_command"  # somebody else commands the chassis


_D, _G, _E, _X = VehicleState

# By the state before. A state that is not named stays as it is.
LEADS_TO: Dict[Enum, Dict[VehicleState, VehicleState]] = {
    VehicleEvent.ENABLE: {_D: _G, _E: _G, _X: _G},
    VehicleEvent.BRAKE: {_G: _X, _E: _X},
    VehicleEvent.CLOSE: {_G: _D, _E: _D, _X: _D},
    VehicleEvent.CONFIRMED: {_G: _E},
    VehicleEvent.NOT_CONFIRMED: {_G: _X},
    VehicleEvent.COMMAND_LATE: {_E: _X},  # while ENABLING nothing moves yet
    VehicleEvent.REMOTE: {_G: _X, _E: _X},
    VehicleEvent.ESTOP: {_G: _X, _E: _X},
    VehicleEvent.STANDBY: {_E: _X},  # ENABLING is there to end this, and the next three
    VehicleEvent.LOCKED: {_E: _X},
    VehicleEvent.FAULT: {_E: _X},
    Fault.SILENT: {_E: _X},
    Fault.LYING: {_G: _X, _E: _X},  # no confirmation can follow
    Fault.STUCK: {_E: _X},
    Fault.STEERING_STUCK: {_E: _X},
    VehicleEvent.BUS: {_G: _X, _E: _X},
    VehicleEvent.FOREIGN: {_G: _X, _E: _X},
}


class Speeds:
    """The speeds that a vehicle reported in the last 0.1 s."""

    def __init__(self) -> None:
        self.silence_s = 0.2  # without feedback for so long the vehicle is silent
        self._noted: Deque[Tuple[float, float]] = deque([(-math.inf, 0.0)])

    def note(self, speed_mps: float, now_s: float) -> None:
        self._noted.append((now_s, speed_mps))
        while self._noted[0][0] < now_s - _WINDOW_S:
            self._noted.popleft()

    @property
    def speed_mps(self) -> float:
        """The newest speed, 0 before the first."""
        return self._noted[-1][1]

    @property
    def stands(self) -> bool:
        return abs(self.speed_mps) < STANDS_MPS

    def acceleration_mps2(self) -> float:
        """Return the mean of the last 0.1 s; 0 while there is too little to tell."""
        (since_s, before_mps), (now_s, speed_mps) = self._noted[0], self._noted[-1]
        return (speed_mps - before_mps) / (now_s - since_s) if now_s > since_s else 0.0


class StreamedCore(abc.ABC):
    """The state machine and its set-point. `heard` holds the speeds that the vehicle reported."""

    def __init__(self, similarity: Similarity, heard: Speeds) -> None:
        self.state = VehicleState.DISABLED
        self.cause: Optional[Enum] = None  # what stopped it
        self.words = ""  # the same for a person; empty where our own side asked for the stop
        self.set_point = SetPoint(similarity)
        self.similarity, self._spec, self._heard = similarity, similarity.spec, heard
        self.follow_period(MIN_PERIOD_S)
        self._drive_watch = DriveWatch(self._spec, heard.silence_s)
        self._wish: Optional[Wish] = None  # None: stand
        self._wished_s = self._ticked_s = -math.inf
        self._since_s = -math.inf  # when this state began

    def follow_period(self, control_period_s: float) -> None:
        """Set how long a command holds and feedback may be missing, from the policy's period T."""
        self.command_timeout_s = SILENCE_PERIODS * control_period_s + BEAT_S
        self._heard.silence_s = max(2 * control_period_s, LEAST_SILENCE_S)

    def enable(self, now_s: float) -> None:
        self._drive_watch = DriveWatch(self._spec, self._heard.silence_s)  # a new chance to follow
        self._apply(Finding(VehicleEvent.ENABLE), now_s)
        self._since_s = now_s

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Take the newest command; ignore it unless ENABLED. Raises ValueError as `wish_of`."""
        wish = wish_of(action, scenario_speed_mps)
        if self.state is VehicleState.ENABLED:
            self._wish, self._wished_s = wish, now_s

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Ask for speed 0 until the next command, or (latched) the next `enable`."""
        self._wish = None
        self.set_point.speed_mps = 0.0
        if latch:
            self._apply(Finding(VehicleEvent.BRAKE), now_s)

    @property
    def late_at_s(self) -> float:
        """When the newest command becomes too old to be obeyed; inf where there is none."""
        return math.inf if self._wish is None else self._wished_s + self.command_timeout_s

    def report(self, now_s: float) -> VehicleReport:
        heard, asked_mps, standing = self._heard, self.set_point.speed_mps, self.standing(now_s)
        brakes = heard.stands and asked_mps == 0.0
        pedal = -1.0 if brakes else self.similarity.pedal(heard.acceleration_mps2())
        centre_rad = self._centre_rad()
        steering = self.similarity.steering(self._asked_rad() if centre_rad is None else centre_rad)
        words = [self.words] if self.words else []
        faults = words + [more for more in standing if more not in words]
        return VehicleReport(
            # Unclamped, a milliradian beyond the reach would count as a lie.
            action={"pedal": pedal, "steering": clamp(steering, self.similarity.reach)},
            speed_mps=heard.speed_mps,
            self_braking=self.state is not VehicleState.ENABLED,
            faults=faults if self.state is VehicleState.STOPPED else [],
            standing=standing,
            scenario_speed_mps=heard.speed_mps / self.similarity.scale,
            commanded_speed_mps=asked_mps,
        )

    def standing(self, now_s: float) -> List[str]:
        """Return in words why an `enable` now would fail."""
        silence = None if self._has_asked else self._silence(-math.inf, now_s)
        return [silence.words] if silence else []

    @abc.abstractmethod
    def is_at_rest(self, now_s: float) -> bool:
        """Return whether the vehicle is known to stand, or no more can be done about it."""

    @abc.abstractmethod
    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        """Return SILENT where feedback is missing that was due since `since_s`."""

    @abc.abstractmethod
    def _centre_rad(self) -> Optional[float]:
        """Return the steering angle that the vehicle reports; None where it is not known."""

    @property
    def _has_asked(self) -> bool:
        return self.state in (VehicleState.ENABLING, VehicleState.ENABLED)

    def _asked_rad(self) -> float:
        return self._spec.centre_rad(self.set_point.inner_rad)

    def _hindrance(self, now_s: float) -> Optional[Finding]:
        """Return why the vehicle did not confirm an `enable`, where that is known."""
        return self._silence(self._since_s, now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        after = LEADS_TO[finding.event].get(self.state, self.state)
        if after is self.state:
            return
        self.state, self._since_s, self._wish = after, now_s, None
        self.set_point.speed_mps = 0.0  # whatever state comes next begins at a stand
        self.cause, self.words = finding if after is VehicleState.STOPPED else (None, "")

    def _look(self, now_s: float) -> None:
        if self.state is VehicleState.ENABLING and now_s - self._since_s > ENABLE_TIMEOUT_S:
            words = f"not enabled within {ENABLE_TIMEOUT_S:.0f} s"
            if why := self._hindrance(now_s):
                words += f": {why.words}"
            self._apply(Finding(VehicleEvent.NOT_CONFIRMED, words), now_s)
        if self.state is not VehicleState.ENABLED:
            return
        asked_mps, heard = self.set_point.speed_mps, self._heard
        drives = asked_mps > 0.0 and not heard.stands  # a wheel need not turn at a stand
        stuck = self._drive_watch.stuck(
            (asked_mps, self._asked_rad()),
            (heard.speed_mps, self._centre_rad() if drives else None),
            now_s,
        )
        words = f"no command for {self.command_timeout_s:.2f} s"
        late = Finding(VehicleEvent.COMMAND_LATE, words) if now_s > self.late_at_s else None
        if finding := self._silence(self._since_s, now_s) or late or stuck:
            self._apply(finding, now_s)

    def _step(self, now_s: float) -> None:
        """Move the set-point by the time since the last tick."""
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.state is VehicleState.ENABLED and self._wish is not None:
            self.set_point.follow(self._wish, step_s, self._heard.speed_mps)
        else:
            self.set_point.speed_mps = 0.0


class StreamedVehicle(Vehicle):
    """Locks every call of a core, and sends in a thread what the core's `tick` returns.

    A driver starts `_stream` at the end of `__init__`. Bus and network are called outside of the
    lock, so that no caller waits for them.
    """

    settings_type: ClassVar[Type[RobotSettings]]

    def __init__(self, core: StreamedCore) -> None:
        self._core = core
        self.limits, self.model_limits = core.similarity.limits(), core.similarity.model()
        self._lock = threading.Lock()
        self._closed = self._ending = self._is_mute = False
        self._logged = ("", "")
        self._wake = threading.Event()  # send now
        self._stream = threading.Thread(target=self._run, name=f"{self.name}-stream", daemon=True)

    @classmethod
    def open(cls, settings: Mapping[str, Any], manifest: Manifest) -> Vehicle:
        parsed, similarity = cls._read(settings, manifest)
        make: Any = cls  # takes the driver's own settings
        vehicle: Vehicle = make(parsed, similarity)
        return vehicle

    @classmethod
    def limits_of(cls, settings: Mapping[str, Any], manifest: Manifest) -> Tuple[Limits, Model]:
        _, similarity = cls._read(settings, manifest)
        return similarity.limits(), similarity.model()

    @classmethod
    def _read(cls, settings: Mapping[str, Any], manifest: Manifest) -> Tuple[Any, Similarity]:
        parsed = convert(settings, cls.settings_type, f"vehicle.{cls.name}")
        return parsed, parsed.similarity(cls.name, manifest)

    def take_bounds(self, bounds: Bounds) -> None:
        super().take_bounds(bounds)
        with self._lock:
            self._core.set_point.take_bounds(bounds)

    def enable(self, now_s: float) -> None:
        """Ask for control; `feedback` tells whether it came. Does nothing once closed."""
        if self._closed:
            return
        with self._lock:
            self._core.follow_period(self.control_period_s)
            self._core.enable(now_s)
        self._wake.set()

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        with self._lock:
            self._core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Send speed 0 at once, not with the next period."""
        self._is_mute = False
        with self._lock:
            self._core.brake(now_s, latch)
        self._wake.set()

    def mute(self) -> None:
        self._is_mute = True

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
        end_s = time.monotonic() + STOP_TAKES_S
        while (now_s := time.monotonic()) < end_s:
            with self._lock:
                if self._core.is_at_rest(now_s):
                    break
            time.sleep(PERIOD_S)
        self._ending = True
        self._wake.set()
        self._stream.join(_JOIN_S)  # one that hangs in a bus is left alone
        self._leave()

    @abc.abstractmethod
    def _send_due(self) -> bool:
        """Send what the core's `tick` gives; return whether anything was. Never raises."""

    @abc.abstractmethod
    def _leave(self) -> None:
        """Give control back, and free what is held; the stream has ended."""

    def _late_at_s(self) -> float:
        with self._lock:
            return self._core.late_at_s

    def _run(self) -> None:
        next_s = time.monotonic()  # deadlines are absolute: a chassis takes a pause for a lost link
        while not self._ending:
            self._wake.clear()
            began_s = time.monotonic()
            sent = not self._is_mute and self._send_due()
            now_s = time.monotonic()
            if sent and now_s - began_s > PERIOD_S:
                # A process that was suspended in between has just sent an old command, which the
                # vehicle may obey: the next one does not wait.
                self._wake.set()
            if now_s >= next_s:
                # After a pause one sending, not one for each missed period.
                next_s += (int((now_s - next_s) / PERIOD_S) + 1) * PERIOD_S
            self._wake.wait(max(0.0, min(next_s, self._late_at_s()) - time.monotonic()))
