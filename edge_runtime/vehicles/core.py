"""The driver of a vehicle that must hear from it 50 times a second: pure, and shared by vehicles.

A core is a state machine (LEADS_TO), what was heard of the vehicle, and what is asked of it. It has
no clock, no thread and no bus: its holder (stream.py, a test) serialises the calls, passes
monotonic seconds, and sends what `tick` returns. A vehicle adds what it hears and says.

STOPPED is a latch of our own: a chassis takes commands again by itself when they resume after its
time-out, when the remote control lets go, or when an error passes. Only ENABLE leads out.
"""

from __future__ import annotations

import abc
import math
from collections import deque
from enum import Enum
from typing import Deque, Dict, List, Optional, Tuple

from edge_runtime.manifest import MIN_PERIOD_S
from edge_runtime.safety import SILENCE_PERIODS
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mapping import SetPoint, Similarity, Wish, clamp, wish_of
from edge_runtime.vehicles.plausibility import ENABLE_TIMEOUT_S, DriveWatch, Fault, Finding

# A beat later than the runtime's own silence rule, which then tells the reason.
BEAT_S = 0.02
LEAST_SILENCE_S = 0.06  # three reports of a vehicle that sends fifty a second
# At the end zeros go out for so long, unless it is known to stand before; and what is then not
# known to stand gets the parking brake, where there is one.
STOP_TAKES_S = 1.0
STANDS_MPS = 0.02
_WINDOW_S = 0.11


class VehicleState(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class VehicleEvent(str, Enum):
    """What can happen, besides a `Fault`. After CLOSE: what the vehicle, the bus or time do."""

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
    VehicleEvent.STANDBY: {_E: _X},  # what ENABLING is to end; so are the next three
    VehicleEvent.LOCKED: {_E: _X},
    VehicleEvent.FAULT: {_E: _X},
    Fault.SILENT: {_E: _X},
    Fault.LYING: {_G: _X, _E: _X},  # it confirms nothing, and need not be waited for
    Fault.STUCK: {_E: _X},
    Fault.STEERING_STUCK: {_E: _X},
    VehicleEvent.BUS: {_G: _X, _E: _X},
    VehicleEvent.FOREIGN: {_G: _X, _E: _X},
}


class Speeds:
    """The speeds that a vehicle reported in the last 0.1 s, and what follows from them.

    It counts as silent after `silence_s` without feedback.
    """

    def __init__(self) -> None:
        self.silence_s = 0.2
        self._noted: Deque[Tuple[float, float]] = deque()

    def note(self, speed_mps: float, now_s: float) -> None:
        self._noted.append((now_s, speed_mps))
        while self._noted[0][0] < now_s - _WINDOW_S:
            self._noted.popleft()

    def forget(self) -> None:
        self._noted.clear()

    @property
    def speed_mps(self) -> float:
        """The newest speed, 0 before the first."""
        return self._noted[-1][1] if self._noted else 0.0

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return abs(self.speed_mps) < STANDS_MPS

    def acceleration_mps2(self) -> float:
        """Return the mean of the last 0.1 s; 0 while there is too little to tell."""
        if len(self._noted) < 2:
            return 0.0
        (since_s, before_mps), (now_s, speed_mps) = self._noted[0], self._noted[-1]
        return (speed_mps - before_mps) / (now_s - since_s) if now_s > since_s else 0.0


class StreamedCore(abc.ABC):
    """The state machine, and what is asked for. `heard` is what the vehicle said of itself."""

    def __init__(self, similarity: Similarity, heard: Speeds) -> None:
        self.state = VehicleState.DISABLED
        self.cause: Optional[Enum] = None  # what stopped it
        self.words = ""  # the same for a person; empty where our own side asked for the stop
        self.set_point = SetPoint(similarity)
        self.similarity, self._spec, self._heard = similarity, similarity.spec, heard
        self._reach = similarity.reach  # worked out once: reports come with every frame
        self.follow_period(MIN_PERIOD_S)
        self._drive_watch = DriveWatch(self._spec, heard.silence_s)
        self._wish: Optional[Wish] = None  # None: stand
        self._wished_s = self._ticked_s = -math.inf
        self._since_s = -math.inf  # when this state began

    def follow_period(self, control_period_s: float) -> None:
        """Take the policy's control period T: how long a command holds, and feedback may miss."""
        self.command_timeout_s = SILENCE_PERIODS * control_period_s + BEAT_S
        self._heard.silence_s = max(2 * control_period_s, LEAST_SILENCE_S)

    def enable(self, now_s: float) -> None:
        self._drive_watch = DriveWatch(self._spec, self._heard.silence_s)  # a new chance to follow
        self._apply(Finding(VehicleEvent.ENABLE, ""), now_s)
        self._since_s = now_s

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Take the newest command; forget it where it may not drive. ValueError: see `wish_of`."""
        wish = wish_of(action, scenario_speed_mps)
        if self.state is VehicleState.ENABLED:
            self._wish, self._wished_s = wish, now_s

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Ask for speed 0 until the next command, or (latched) the next `enable`."""
        self._wish = None
        self.set_point.speed_mps = 0.0
        if latch:
            self._apply(Finding(VehicleEvent.BRAKE, ""), now_s)

    @property
    def late_at_s(self) -> float:
        """When the newest command becomes too old to be obeyed; inf where there is none."""
        return math.inf if self._wish is None else self._wished_s + self.command_timeout_s

    def report(self, now_s: float) -> VehicleReport:
        speed_mps, standing = self._heard.speed_mps, self.standing(now_s)
        centre_rad = self._centre_rad()
        steering = self.similarity.steering(self._asked_rad() if centre_rad is None else centre_rad)
        words = [self.words] if self.words else []
        faults = words + [more for more in standing if more not in words]
        return VehicleReport(
            # A milliradian beyond its reach would count as a lie.
            action={"pedal": self._pedal(), "steering": clamp(steering, self._reach)},
            speed_mps=speed_mps,
            self_braking=self.state is not VehicleState.ENABLED,
            faults=faults if self.state is VehicleState.STOPPED else [],
            standing=standing,
            scenario_speed_mps=speed_mps / self.similarity.scale,
            commanded_speed_mps=self.set_point.speed_mps,
        )

    def standing(self, now_s: float) -> List[str]:
        """Return in words what would make an `enable` now be in vain."""
        return [] if self._has_asked else self._obstacles(now_s)

    @abc.abstractmethod
    def is_at_rest(self, now_s: float) -> bool:
        """Return whether the vehicle is known to stand, or no more can be done about it."""

    @abc.abstractmethod
    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        """Return SILENT where feedback is missing that was due since `since_s`."""

    @abc.abstractmethod
    def _why_not_confirmed(self, now_s: float) -> str:
        """Return in words why the vehicle did not confirm an `enable` in time."""

    @abc.abstractmethod
    def _centre_rad(self) -> Optional[float]:
        """Return the steering angle that the vehicle reports; None where it is not known."""

    @property
    def _has_asked(self) -> bool:
        return self.state in (VehicleState.ENABLING, VehicleState.ENABLED)

    def _asked_rad(self) -> float:
        return self._spec.centre_rad(self.set_point.inner_rad)

    def _obstacles(self, now_s: float) -> List[str]:
        """Return in words what stands between the vehicle and our commands."""
        silence = self._silence(-math.inf, now_s)
        return [silence.words] if silence else []

    def _apply(self, finding: Finding, now_s: float) -> None:
        after = LEADS_TO[finding.event].get(self.state, self.state)
        if after is self.state:
            return
        self.state, self._since_s, self._wish = after, now_s, None
        self.set_point.speed_mps = 0.0  # whatever state comes next begins at a stand
        self.cause, self.words = finding if after is VehicleState.STOPPED else (None, "")

    def _look(self, now_s: float) -> None:
        """Find what time alone tells."""
        if self.state is VehicleState.ENABLING and now_s - self._since_s > ENABLE_TIMEOUT_S:
            why = self._why_not_confirmed(now_s)
            self._apply(Finding(VehicleEvent.NOT_CONFIRMED, why), now_s)
        if self.state is not VehicleState.ENABLED:
            return
        asked_mps, heard = self.set_point.speed_mps, self._heard
        drives = asked_mps > 0.0 and not heard.stands  # a wheel need not turn at a stand
        stuck = self._drive_watch.stuck(
            (asked_mps, self._asked_rad()),
            (heard.speed_mps, self._centre_rad() if drives else None),
            now_s,
        )
        found = self._silence(self._since_s, now_s) or self._late(now_s) or stuck
        if found is not None:
            self._apply(found, now_s)

    def _late(self, now_s: float) -> Optional[Finding]:
        words = f"no command for {self.command_timeout_s:.2f} s"
        return Finding(VehicleEvent.COMMAND_LATE, words) if now_s > self.late_at_s else None

    def _step(self, now_s: float) -> None:
        """Move the set-point by the time since the last tick."""
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.state is VehicleState.ENABLED and self._wish is not None:
            self.set_point.follow(self._wish, step_s, self._heard.speed_mps)
        else:
            self.set_point.speed_mps = 0.0

    def _pedal(self) -> float:
        """Return the pedal of the measured acceleration; the brake of a stand that was asked."""
        if self._heard.stands and self.set_point.speed_mps == 0.0:
            return -1.0
        return self.similarity.pedal(self._heard.acceleration_mps2())
