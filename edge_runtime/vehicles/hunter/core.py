"""The driver of a Hunter without clock, thread and bus: frames and time in, frames out.

First what was heard of the chassis, and which event of the state machine it is; then the core,
which is given every frame of the bus, and whose `tick` gives the frames to send. Pure.
"""

from __future__ import annotations

import math
from typing import Dict, List, Optional

from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import (
    STOP_TAKES_S,
    Speeds,
    State,
    StreamedCore,
    VehicleEvent,
)
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.protocol import MotionStatus, MotorSlow, Sent, SystemStatus
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.vehicles.plausibility import ENABLE_TIMEOUT_S, Fault, Finding, impossible

STATUS_SILENCE_S = 0.3  # three frames of 0x211; 0x221 comes five times as often
COUNTERS = 256  # byte 7 of 0x211 runs over
ASK_AGAIN_S = 0.1  # a frame may be lost, and the chassis answers every 100 ms
BUS_PATIENCE_S = 0.1  # five frames of the stream


def _sent(frame: protocol.Frame, message: object) -> Sent:
    return Sent(frame, protocol.encode(frame, message))


_TAKE = _sent(protocol.MODE_COMMAND, protocol.ModeCommand(protocol.CAN_CONTROL))
_GIVE_BACK = _sent(protocol.MODE_COMMAND, protocol.ModeCommand(protocol.STANDBY))
_RELEASE = _sent(protocol.BRAKE_COMMAND, protocol.BrakeCommand(0))
_LOCK = _sent(protocol.BRAKE_COMMAND, protocol.BrakeCommand(1))
_CLEAR = _sent(protocol.CLEAR_COMMAND, protocol.ClearCommand())


class Reports(Speeds):
    """The newest frame of each kind. `hear` is given every frame of the bus."""

    def __init__(self, spec: HunterSpec, profile: str) -> None:
        super().__init__()
        self.status: Optional[SystemStatus] = None
        self.motion: Optional[MotionStatus] = None
        self.status_s = self.motion_s = -math.inf  # of 0x211: when its counter last went on
        self._counter, self._last_status_s = 0, -math.inf
        self._spec, self._profile = spec, profile
        self._motor_faults: Dict[int, List[str]] = {}

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Note a frame; one that is not in the table, or of a wrong length, is none."""
        message = protocol.decode(can_id, data)
        if isinstance(message, SystemStatus):
            self.status = message
            self._count(message.counter, now_s)
        elif isinstance(message, MotionStatus):
            self.motion, self.motion_s = message, now_s
            self.note(message.speed_mps, now_s)
        elif isinstance(message, MotorSlow):
            self._motor_faults[can_id] = protocol.motor_faults(can_id, message)

    def is_known_to_stand(self, now_s: float) -> bool:
        """Whether it says now that it stands."""
        return self.stands and now_s - self.motion_s <= self.silence_s

    @property
    def needs_clearing(self) -> bool:
        """Whether it shows an error; a lost link goes by itself, with the stream's first frame."""
        is_exception = self.status is not None and self.status.state == protocol.STATE_EXCEPTION
        return is_exception or bool(set(self.errors()) - {protocol.LINK_LOST})

    @property
    def remote_drives(self) -> bool:
        """Whether the remote control had the vehicle when it was last heard."""
        return self.status is not None and self.status.mode == protocol.REMOTE_CONTROL

    def errors(self) -> List[str]:
        """The errors that the chassis names, in words, without those of its operation."""
        words = protocol.status_faults(self.status, self._profile) if self.status else []
        for motor in self._motor_faults.values():
            words += motor
        return words

    def silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        """SILENT where feedback is missing that was due since `since_s`."""
        if now_s - max(self.motion_s, since_s) > self.silence_s:
            return Finding(Fault.SILENT, "the chassis sends no 0x221")
        if now_s - max(self.status_s, since_s) > STATUS_SILENCE_S:
            repeats = now_s - self._last_status_s <= STATUS_SILENCE_S
            words = "repeats itself: the counter of 0x211 stands still"
            return Finding(Fault.SILENT, f"the chassis {words if repeats else 'sends no 0x211'}")
        return None

    def commander(self) -> Optional[Finding]:
        """What outranks us: the remote control, or the emergency stop."""
        if self.remote_drives:
            return Finding(VehicleEvent.REMOTE, "the remote control drives")
        if self.status is not None and self.status.state == protocol.STATE_ESTOP:
            return Finding(VehicleEvent.ESTOP, "the emergency stop is pressed")
        return None

    def finding(self) -> Optional[Finding]:
        """What stands between the chassis and our commands now; the gravest only."""
        status = self.status
        if status is None:
            return Finding(Fault.SILENT, "the chassis sends no 0x211")
        outranked = self.commander()
        if outranked is not None:
            return outranked
        errors = self.errors()
        if errors:
            return Finding(VehicleEvent.FAULT, ", ".join(errors))
        if status.state != protocol.STATE_OK:
            return Finding(
                VehicleEvent.FAULT, f"the chassis is in state {status.state} (exception)"
            )
        if status.mode != protocol.CAN_CONTROL:
            name = "standby" if status.mode == protocol.STANDBY else f"mode {status.mode}"
            return Finding(VehicleEvent.STANDBY, f"the chassis is in {name}, not under CAN control")
        if status.brake:
            return Finding(VehicleEvent.LOCKED, "the chassis has locked its brake")
        return self.lie()

    def _count(self, counter: int, now_s: float) -> None:
        """A status is a sign of life where its counter is ahead of all before, or it was silent.

        Up to 127 ahead is newer: frames that are replayed lie behind, and do not count.
        """
        was_silent = now_s - self._last_status_s > STATUS_SILENCE_S
        if was_silent or 0 < (counter - self._counter) % COUNTERS < COUNTERS // 2:
            self._counter, self.status_s = counter, now_s
        self._last_status_s = now_s

    def lie(self) -> Optional[Finding]:
        """LYING where it reports what the model cannot do."""
        if self.motion is None:
            return None
        words = impossible(*self.motion, self._spec)
        return Finding(Fault.LYING, f"the chassis reports {words}") if words else None


class HunterCore(StreamedCore):
    """The state machine, what was heard, and what is asked for."""

    def __init__(self, similarity: Similarity, profile: str) -> None:
        self.reports = Reports(similarity.spec, profile)
        super().__init__(similarity, self.reports)
        self._ask_s = math.inf  # when to ask the chassis for something next
        self._bus_words = ""  # empty while it works
        self._bus_failed_s = math.inf  # when the failures began

    def enable(self, now_s: float) -> None:
        """Ask for control, from now on until the chassis confirms it."""
        super().enable(now_s)
        self._ask_s = now_s

    def close(self, now_s: float) -> List[Sent]:
        """The last frames: stand, park, give control back. None where it was never taken."""
        if self.state is State.DISABLED:
            return []
        self._apply(Finding(VehicleEvent.CLOSE, ""), now_s)
        park = [] if self.reports.remote_drives else [_LOCK]
        return [self._motion(), *park, _GIVE_BACK]

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """A frame of the bus, from any sender; never raises."""
        if self.state is State.DISABLED:
            self.bus_works()  # nothing is sent then that it could take
        if can_id in protocol.COMMAND_IDS:
            self._apply(Finding(VehicleEvent.FOREIGN, f"somebody else sends 0x{can_id:x}"), now_s)
            return
        self.reports.hear(can_id, data, now_s)
        if can_id == protocol.SYSTEM_STATUS.can_id or can_id in protocol.MOTOR_OF_SLOW:
            self._judge(now_s)
        elif can_id == protocol.MOTION_STATUS.can_id:
            # At once, not with the next tick: else the runtime's own watch would stop it first,
            # and what it then says is over with the lie.
            lie = self.reports.lie()
            if lie is not None:
                self._apply(lie, now_s)

    def bus_failed(self, words: str, now_s: float, fatal: bool = False) -> None:
        """The bus did not take a frame, or gave none; `fatal`: it says that it is off."""
        self._bus_failed_s = min(self._bus_failed_s, now_s)
        if fatal or now_s - self._bus_failed_s > BUS_PATIENCE_S:
            self._bus_words = f"the CAN bus fails: {words}"
            self._apply(Finding(VehicleEvent.BUS, self._bus_words), now_s)

    def bus_works(self) -> None:
        """The bus took a frame, or (while none is sent) gave one."""
        self._bus_failed_s, self._bus_words = math.inf, ""

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
        status = self.reports.status
        return super().report(now_s)._replace(battery_v=status.battery_v if status else None)

    def is_at_rest(self, now_s: float) -> bool:
        """As in StreamedCore; no more can be done about a dead bus or a remote control."""
        blind = self.state is State.DISABLED or bool(self._bus_words) or self.reports.remote_drives
        return blind or self.reports.is_known_to_stand(now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        before = self.state
        super()._apply(finding, now_s)
        if self.state is not before and self.state is State.STOPPED:
            at_once = finding.event is Fault.STUCK  # no set-point will stop it: the brake must
            self._ask_s = now_s + (0.0 if at_once else STOP_TAKES_S)
        elif self.state is State.ENABLED:
            self._ask_s = math.inf

    def _judge(self, now_s: float) -> None:
        """What the chassis's newest status means."""
        finding = self.reports.finding()
        if self.state is State.ENABLING and self.reports.status_s <= self._since_s:
            return  # from before it was asked
        self._apply(finding or Finding(VehicleEvent.CONFIRMED, ""), now_s)

    def _obstacles(self, now_s: float) -> List[str]:
        outranked = self.reports.commander()
        words = [outranked.words] if outranked else []
        return words + super()._obstacles(now_s) + ([self._bus_words] if self._bus_words else [])

    def _why_not_confirmed(self, now_s: float) -> str:
        why = self._silence(self._since_s, now_s) or self.reports.finding()
        words = f"not enabled within {ENABLE_TIMEOUT_S:.0f} s"
        return f"{words}: {why.words}" if why else words

    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        return self.reports.silence(since_s, now_s)

    def _requests(self, now_s: float) -> List[Sent]:
        """Beside the stream: for control while ENABLING, for the brake while STOPPED."""
        self._ask_s = now_s + ASK_AGAIN_S
        if self.state is State.STOPPED:
            # A person with the remote control knows better than we do.
            if self.reports.remote_drives or self.reports.is_known_to_stand(now_s):
                return []
            return [_LOCK]
        clear = [_CLEAR] if self.reports.needs_clearing else []
        return [*clear, _TAKE, _RELEASE]

    def _motion(self) -> Sent:
        asked = self.set_point
        data = protocol.encode_motion(asked.speed_mps, asked.inner_rad, self._spec)
        return Sent(protocol.MOTION_COMMAND, data)

    def _centre_rad(self) -> Optional[float]:
        motion = self.reports.motion
        return self._spec.centre_rad(motion.inner_steering_rad) if motion else None
