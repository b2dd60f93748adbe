"""How the driver sees the chassis: a pure state machine. TRANSITIONS is all of it.

STOPPED is a latch of our own: the chassis gives control back by itself when frames resume after
its time-out, when the remote control lets go, or when an error passes. Only ENABLE leads out.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Dict, List, NamedTuple, Optional, Tuple

from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import (
    IMPOSSIBLE,
    SetPoint,
    Speeds,
    SpeedWatch,
    Wish,
    steering_of,
    wish_of,
)
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.protocol import (
    LINK_LOST,
    MotionStatus,
    MotorSlow,
    Sent,
    SystemStatus,
    motor_faults,
    status_faults,
)
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.vehicles.stream import COMMAND_TIMEOUT_S, STOP_TAKES_S, Core
from edge_runtime.wire import CONTROL_PERIOD_S


class State(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class Event(str, Enum):
    """What can happen. All after CLOSE are what the chassis, the bus or time do."""

    ENABLE = "enable"
    BRAKE = "brake"
    CLOSE = "close"
    CONFIRMED = "confirmed"  # CAN control, brake released, no error
    NOT_CONFIRMED = "not_confirmed"  # within ENABLE_TIMEOUT_S
    COMMAND_LATE = "command_late"  # no fresh command for 2 T
    REMOTE = "remote_control"
    ESTOP = "emergency_stop"
    STANDBY = "chassis_standby"  # or another mode that is not CAN control
    LOCKED = "brake_locked"
    FAULT = "chassis_fault"
    SILENT = "feedback_silent"
    LYING = "feedback_impossible"
    STUCK = "speed_stuck"
    BUS = "bus_error"
    FOREIGN = "foreign_command"  # somebody else commands the chassis


_D, _G, _E, _X = State.DISABLED, State.ENABLING, State.ENABLED, State.STOPPED

TRANSITIONS: Dict[Tuple[State, Event], State] = {
    (_D, Event.ENABLE): _G,
    (_D, Event.BRAKE): _D,
    (_D, Event.CLOSE): _D,
    (_D, Event.CONFIRMED): _D,
    (_D, Event.NOT_CONFIRMED): _D,
    (_D, Event.COMMAND_LATE): _D,
    (_D, Event.REMOTE): _D,
    (_D, Event.ESTOP): _D,
    (_D, Event.STANDBY): _D,
    (_D, Event.LOCKED): _D,
    (_D, Event.FAULT): _D,
    (_D, Event.SILENT): _D,
    (_D, Event.LYING): _D,
    (_D, Event.STUCK): _D,
    (_D, Event.BUS): _D,
    (_D, Event.FOREIGN): _D,
    (_G, Event.ENABLE): _G,
    (_G, Event.BRAKE): _X,
    (_G, Event.CLOSE): _D,
    (_G, Event.CONFIRMED): _E,
    (_G, Event.NOT_CONFIRMED): _X,
    (_G, Event.COMMAND_LATE): _G,  # nothing moves yet
    (_G, Event.REMOTE): _X,
    (_G, Event.ESTOP): _X,
    (_G, Event.STANDBY): _G,  # what is to be ended; so for the next three
    (_G, Event.LOCKED): _G,
    (_G, Event.FAULT): _G,
    (_G, Event.SILENT): _G,
    (_G, Event.LYING): _G,
    (_G, Event.STUCK): _G,
    (_G, Event.BUS): _X,
    (_G, Event.FOREIGN): _X,
    (_E, Event.ENABLE): _G,
    (_E, Event.BRAKE): _X,
    (_E, Event.CLOSE): _D,
    (_E, Event.CONFIRMED): _E,
    (_E, Event.NOT_CONFIRMED): _E,
    (_E, Event.COMMAND_LATE): _X,
    (_E, Event.REMOTE): _X,
    (_E, Event.ESTOP): _X,
    (_E, Event.STANDBY): _X,
    (_E, Event.LOCKED): _X,
    (_E, Event.FAULT): _X,
    (_E, Event.SILENT): _X,
    (_E, Event.LYING): _X,
    (_E, Event.STUCK): _X,
    (_E, Event.BUS): _X,
    (_E, Event.FOREIGN): _X,
    (_X, Event.ENABLE): _G,
    (_X, Event.BRAKE): _X,
    (_X, Event.CLOSE): _D,
    (_X, Event.CONFIRMED): _X,
    (_X, Event.NOT_CONFIRMED): _X,
    (_X, Event.COMMAND_LATE): _X,
    (_X, Event.REMOTE): _X,
    (_X, Event.ESTOP): _X,
    (_X, Event.STANDBY): _X,
    (_X, Event.LOCKED): _X,
    (_X, Event.FAULT): _X,
    (_X, Event.SILENT): _X,
    (_X, Event.LYING): _X,
    (_X, Event.STUCK): _X,
    (_X, Event.BUS): _X,
    (_X, Event.FOREIGN): _X,
}


def render_table() -> str:
    """TRANSITIONS as a Markdown table: a row for each event, a column for each state."""
    lines = [
        "| event | " + " | ".join(f"in {state.value}" for state in State) + " |",
        "|---" * (len(State) + 1) + "|",
    ]
    for event in Event:
        cells = (TRANSITIONS[state, event].value for state in State)
        lines.append(f"| {event.value} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


MOTION_SILENCE_S = 2 * CONTROL_PERIOD_S  # ten frames of 0x221
STATUS_SILENCE_S = 3 * CONTROL_PERIOD_S  # three frames of 0x211
COUNTERS = 256  # byte 7 of 0x211 runs over

REMOTE_WORDS = "the remote control drives"
ESTOP_WORDS = "the emergency stop is pressed"


class Finding(NamedTuple):
    """An event with what it is in words."""

    event: Event
    words: str


class Reports:
    """The newest frame of each kind. `hear` is given every frame of the bus."""

    def __init__(self, spec: HunterSpec, profile: str) -> None:
        self.status: Optional[SystemStatus] = None
        self.motion: Optional[MotionStatus] = None
        self.status_s = self.motion_s = -math.inf  # of 0x211: when its counter last went on
        self._counter, self._last_status_s = 0, -math.inf
        self._spec, self._profile = spec, profile
        self._motor_faults: Dict[int, List[str]] = {}
        self._speeds = Speeds()

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Note a frame; one that is not in the table, or of a wrong length, is none."""
        decoded = protocol.decode(can_id, data)
        if decoded is None:
            return
        message = decoded.message
        if isinstance(message, SystemStatus):
            self.status = message
            self._count(message.counter, now_s)
        elif isinstance(message, MotionStatus):
            self.motion, self.motion_s = message, now_s
            self._speeds.note(message.speed_mps, now_s)
        elif isinstance(message, MotorSlow):
            self._motor_faults[can_id] = motor_faults(can_id, message)

    @property
    def speed_mps(self) -> float:
        """The newest speed, 0 before the first."""
        return self._speeds.newest_mps

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return self._speeds.stands

    def is_known_to_stand(self, now_s: float) -> bool:
        """Whether it says now that it stands."""
        return self.stands and now_s - self.motion_s <= MOTION_SILENCE_S

    @property
    def needs_clearing(self) -> bool:
        """Whether it shows an error; a lost link goes by itself, with the stream's first frame."""
        is_exception = self.status is not None and self.status.state == protocol.STATE_EXCEPTION
        return is_exception or bool(set(self.errors()) - {LINK_LOST})

    @property
    def remote_drives(self) -> bool:
        """Whether the remote control had the vehicle when it was last heard."""
        return self.status is not None and self.status.mode == protocol.REMOTE_CONTROL

    def acceleration_mps2(self) -> float:
        """Over the last control period; 0 while there is too little to tell."""
        return self._speeds.acceleration_mps2()

    def errors(self) -> List[str]:
        """The errors that the chassis names, in words, without those of its operation."""
        words = status_faults(self.status, self._profile) if self.status else []
        for motor in self._motor_faults.values():
            words += motor
        return words

    def silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        """SILENT where feedback is missing that was due since `since_s`."""
        if now_s - max(self.motion_s, since_s) > MOTION_SILENCE_S:
            return Finding(Event.SILENT, "the chassis sends no 0x221")
        if now_s - max(self.status_s, since_s) > STATUS_SILENCE_S:
            repeats = now_s - self._last_status_s <= STATUS_SILENCE_S
            words = "repeats itself: the counter of 0x211 stands still"
            return Finding(Event.SILENT, f"the chassis {words if repeats else 'sends no 0x211'}")
        return None

    def commander(self) -> Optional[Finding]:
        """Who outranks us: the remote control, or the emergency stop."""
        if self.remote_drives:
            return Finding(Event.REMOTE, REMOTE_WORDS)
        if self.status is not None and self.status.state == protocol.STATE_ESTOP:
            return Finding(Event.ESTOP, ESTOP_WORDS)
        return None

    def finding(self) -> Optional[Finding]:
        """What stands between the chassis and our commands now; the gravest only."""
        status = self.status
        if status is None:
            return Finding(Event.SILENT, "the chassis sends no 0x211")
        outranked = self.commander()
        if outranked is not None:
            return outranked
        errors = self.errors()
        if errors:
            return Finding(Event.FAULT, ", ".join(errors))
        if status.state != protocol.STATE_OK:
            return Finding(Event.FAULT, f"the chassis is in state {status.state} (exception)")
        if status.mode != protocol.CAN_CONTROL:
            name = "standby" if status.mode == protocol.STANDBY else f"mode {status.mode}"
            return Finding(Event.STANDBY, f"the chassis is in {name}, not under CAN control")
        if status.brake:
            return Finding(Event.LOCKED, "the chassis has locked its brake")
        return None

    def _count(self, counter: int, now_s: float) -> None:
        """A status is a sign of life where its counter is ahead of all before, or it was silent.

        Half of the circle is ahead: frames that go round and round are behind their newest one.
        """
        was_silent = now_s - self._last_status_s > STATUS_SILENCE_S
        if was_silent or 0 < (counter - self._counter) % COUNTERS < COUNTERS // 2:
            self._counter, self.status_s = counter, now_s
        self._last_status_s = now_s

    def lie(self) -> Optional[Finding]:
        """LYING where it reports what the model cannot do."""
        if self.motion is None:
            return None
        speed_mps, inner_rad = self.motion
        if abs(speed_mps) > IMPOSSIBLE * self._spec.max_speed_mps:
            return Finding(Event.LYING, f"the chassis reports {speed_mps:.1f} m/s")
        if abs(inner_rad) > IMPOSSIBLE * self._spec.max_inner_steering_rad:
            return Finding(
                Event.LYING, f"the chassis reports a steering angle of {inner_rad:.2f} rad"
            )
        return None


ENABLE_TIMEOUT_S = 1.0
ASK_AGAIN_S = 0.1  # a frame may be lost, and the chassis answers every 100 ms
BUS_PATIENCE_S = 0.1  # five frames of the stream
_STOPS_AT_ONCE = (Event.STUCK,)  # no set-point will stop it: the brake must


class HunterCore(Core):
    """The state machine, what was heard, and what is asked for."""

    def __init__(self, spec: HunterSpec, profile: str, similarity: Similarity) -> None:
        self.state: State = State.DISABLED
        self.cause: Optional[Event] = None  # what stopped it
        self.reports = Reports(spec, profile)
        self.set_point = SetPoint(spec, similarity)
        self._spec, self._similarity = spec, similarity
        self._speed_watch = SpeedWatch(spec.max_speed_mps)
        self.words = ""  # the same for a person; empty where our own side asked for the stop
        self._wish: Optional[Wish] = None  # None: stand
        self._wished_s = self._ticked_s = -math.inf
        self._since_s = -math.inf  # when this state began
        self._ask_s = math.inf  # when to ask the chassis for something next
        self._bus_words = ""  # empty while it works
        self._bus_failed_s: Optional[float] = None  # when the failures began

    def enable(self, now_s: float) -> None:
        """Ask for control, from now on until the chassis confirms it."""
        self._wish = None
        self._speed_watch.begin()
        self._ask_s = now_s
        self._apply(Finding(Event.ENABLE, ""), now_s)
        self._since_s = now_s

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """The newest command; forgotten where it may not drive. ValueError: see `wish_of`."""
        wish = wish_of(action, scenario_speed_mps)
        if self.state is State.ENABLED:
            self._wish, self._wished_s = wish, now_s

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Speed 0 at the next tick, until the next command or (latched) the next `enable`."""
        self._wish = None
        if latch:
            self._apply(Finding(Event.BRAKE, ""), now_s)

    def close(self, now_s: float) -> List[Sent]:
        """The last frames: stand, park, give control back. None where it was never taken."""
        if self.state is State.DISABLED:
            return []
        self.set_point.stand()
        parts = [
            self._motion(),
            _sent(protocol.MODE_COMMAND, protocol.ModeCommand(protocol.STANDBY)),
        ]
        if not self.reports.remote_drives:
            parts.insert(1, _sent(protocol.BRAKE_COMMAND, protocol.BrakeCommand(1)))
        self._apply(Finding(Event.CLOSE, ""), now_s)
        return parts

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """A frame of the bus, whoever sent it; never raises."""
        if self.state is State.DISABLED:
            self.bus_works()  # nothing is sent then that it could take
        if self.is_command(can_id):
            self._apply(Finding(Event.FOREIGN, f"somebody else sends 0x{can_id:x}"), now_s)
            return
        self.reports.hear(can_id, data, now_s)
        if can_id == protocol.SYSTEM_STATUS.can_id or can_id in protocol.MOTOR_OF_SLOW:
            self._judge(now_s)
        elif can_id == protocol.MOTION_STATUS.can_id:
            # At once, not with the next tick: else the runtime's own watch would stop it first,
            # and what it then says is over with the lie.
            self._apply_if_enabled(self.reports.lie(), now_s)

    def bus_failed(self, words: str, now_s: float, fatal: bool = False) -> None:
        """The bus did not take a frame, or gave none; `fatal`: it says that it is off."""
        if self._bus_failed_s is None:
            self._bus_failed_s = now_s
        if fatal or now_s - self._bus_failed_s > BUS_PATIENCE_S:
            self._bus_words = f"the CAN bus fails: {words}"
            self._apply(Finding(Event.BUS, self._bus_words), now_s)

    def bus_works(self) -> None:
        """The bus took a frame, or (while none is sent) gave one."""
        self._bus_failed_s, self._bus_words = None, ""

    @property
    def late_at_s(self) -> float:
        """After which moment its newest command is too old to be obeyed; inf where it has none."""
        return math.inf if self._wish is None else self._wished_s + COMMAND_TIMEOUT_S

    def tick(self, now_s: float) -> List[Sent]:
        """The frames to send now; none while DISABLED."""
        self._watch(now_s)
        if self.state is State.DISABLED:
            return []
        parts = self._requests(now_s) if now_s >= self._ask_s else []
        self._step(now_s)
        return [*parts, self._motion()]

    def report(self, now_s: float) -> VehicleReport:
        """What the vehicle does, in the policy's terms and in its own."""
        speed_mps = self.reports.speed_mps
        return VehicleReport(
            action={"pedal": self._pedal(), "steering": self._steering()},
            speed_mps=speed_mps,
            self_braking=self.state is not State.ENABLED,
            faults=self._faults(now_s),
            standing=self.standing(now_s),
            scenario_speed_mps=self._similarity.scenario_mps(speed_mps),
            commanded_speed_mps=self.set_point.speed_mps,
            battery_v=self.reports.status.battery_v if self.reports.status else None,
        )

    def standing(self, now_s: float) -> List[str]:
        """What would make an `enable` now be in vain, in words."""
        if self.state not in (State.STOPPED, State.DISABLED):
            return []
        found = [self.reports.commander(), self.reports.silence(-math.inf, now_s)]
        words = [finding.words for finding in found if finding is not None]
        return [*words, self._bus_words] if self._bus_words else words

    @staticmethod
    def is_command(can_id: int) -> bool:
        """Whether it is for the chassis, so that only we should send it."""
        return any(can_id == frame.can_id for frame in protocol.COMMANDS)

    def is_at_rest(self, now_s: float) -> bool:
        """Whether the vehicle is known to stand, or nobody here can do more about it."""
        blind = self.state is State.DISABLED or bool(self._bus_words) or self.reports.remote_drives
        return blind or self.reports.is_known_to_stand(now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        after = TRANSITIONS[self.state, finding.event]
        if after is self.state:
            return
        if after is State.STOPPED:
            self._wish = None
            self.set_point.stand()
            self.cause, self.words = finding.event, finding.words
            at_once = finding.event in _STOPS_AT_ONCE
            self._ask_s = now_s + (0.0 if at_once else STOP_TAKES_S)
        else:
            self.cause, self.words = None, ""
        if after is State.ENABLED:
            self._ask_s = math.inf
        self.state, self._since_s = after, now_s

    def _judge(self, now_s: float) -> None:
        """What the chassis's newest status means."""
        finding = self.reports.finding()
        if self.state is State.ENABLING and self.reports.status_s <= self._since_s:
            return  # from before it was asked
        self._apply(finding or Finding(Event.CONFIRMED, ""), now_s)

    def _watch(self, now_s: float) -> None:
        """What time alone tells."""
        if self.state is State.ENABLING and now_s - self._since_s > ENABLE_TIMEOUT_S:
            why = self.reports.silence(self._since_s, now_s) or self.reports.finding()
            words = f"not enabled within {ENABLE_TIMEOUT_S:.0f} s"
            self._apply(
                Finding(Event.NOT_CONFIRMED, f"{words}: {why.words}" if why else words), now_s
            )
        if self.state is not State.ENABLED:
            return
        found = self.reports.silence(self._since_s, now_s) or self.reports.lie()
        if found is None and self._wish is not None and now_s - self._wished_s > COMMAND_TIMEOUT_S:
            found = Finding(Event.COMMAND_LATE, f"no command for {COMMAND_TIMEOUT_S:.2f} s")
        asked_mps, measured_mps = self.set_point.speed_mps, self.reports.speed_mps
        if self._speed_watch.is_stuck(asked_mps, measured_mps, now_s) and found is None:
            words = f"the speed stays at {measured_mps:.2f} m/s, asked for {asked_mps:.2f}"
            found = Finding(Event.STUCK, words)
        self._apply_if_enabled(found, now_s)

    def _apply_if_enabled(self, finding: Optional[Finding], now_s: float) -> None:
        if finding is not None and self.state is State.ENABLED:
            self._apply(finding, now_s)

    def _requests(self, now_s: float) -> List[Sent]:
        """Beside the stream: for control while ENABLING, for the brake while STOPPED."""
        self._ask_s = now_s + ASK_AGAIN_S
        if self.state is State.STOPPED:
            # A person with the remote control knows better than we do.
            if self.reports.remote_drives or self.reports.is_known_to_stand(now_s):
                return []
            return [_sent(protocol.BRAKE_COMMAND, protocol.BrakeCommand(1))]
        parts = [
            _sent(protocol.MODE_COMMAND, protocol.ModeCommand(protocol.CAN_CONTROL)),
            _sent(protocol.BRAKE_COMMAND, protocol.BrakeCommand(0)),
        ]
        if self.reports.needs_clearing:
            parts.insert(0, _sent(protocol.CLEAR_COMMAND, protocol.ClearCommand()))
        return parts

    def _step(self, now_s: float) -> None:
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.state is State.ENABLED and self._wish is not None:
            self.set_point.follow(self._wish, step_s, self.reports.speed_mps)
        else:
            self.set_point.stand()

    def _motion(self) -> Sent:
        speed_mps, inner_rad = self.set_point.speed_mps, self.set_point.inner_rad
        return Sent(
            protocol.MOTION_COMMAND, protocol.encode_motion(speed_mps, inner_rad, self._spec)
        )

    def _faults(self, now_s: float) -> List[str]:
        if self.state is not State.STOPPED:
            return []
        words = [self.words] if self.words else []
        return words + [more for more in self.standing(now_s) if more not in words]

    def _pedal(self) -> float:
        """From the measured acceleration; the brake where it stands and is to stand."""
        if self.reports.stands and self.set_point.speed_mps == 0.0:
            return -1.0
        return mapping.acceleration_to_pedal(self.reports.acceleration_mps2(), self._similarity)

    def _steering(self) -> float:
        motion = self.reports.motion
        inner_rad = motion.inner_steering_rad if motion else 0.0
        return steering_of(inner_rad, self._spec, self._similarity)


def _sent(frame: protocol.Frame, message: object) -> Sent:
    return Sent(frame, protocol.encode(frame, message))
