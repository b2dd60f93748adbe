"""The driver of a Hunter without clock, thread and bus: frames and time in, frames out. Pure.

`Reports` holds what was heard of the chassis, and says which event that is for the state machine.
The core hears every frame of the bus; its `tick` gives the frames to send.
"""

from __future__ import annotations

import math
from typing import Dict, List, Optional

from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import (
    STOP_TAKES_S,
    Speeds,
    StreamedCore,
    VehicleEvent,
    VehicleState,
)
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.protocol import MotionStatus, MotorSlow, Sent, SystemStatus
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.vehicles.plausibility import (
    ENABLE_TIMEOUT_S,
    Fault,
    Finding,
    Lasting,
    impossible,
)

STATUS_SILENCE_S = 0.3  # three frames of 0x211; 0x221 comes five times as often
COUNTERS = 256  # byte 7 of 0x211 runs over
ASK_AGAIN_S = 0.1  # a frame may be lost, and the chassis answers every 100 ms
BUS_PATIENCE_S = 0.1  # five frames of the stream


_TAKE = protocol.MODE_COMMAND.sent(protocol.ModeCommand(protocol.CAN_CONTROL))
_GIVE_BACK = protocol.MODE_COMMAND.sent(protocol.ModeCommand(protocol.STANDBY))
_RELEASE = protocol.BRAKE_COMMAND.sent(protocol.BrakeCommand(0))
_LOCK = protocol.BRAKE_COMMAND.sent(protocol.BrakeCommand(1))
_CLEAR = protocol.CLEAR_COMMAND.sent(protocol.ClearCommand())


class Reports(Speeds):
    """The newest frame of each kind."""

    def __init__(self, spec: HunterSpec, profile: str) -> None:
        super().__init__()
        self.status: Optional[SystemStatus] = None
        self.motion: Optional[MotionStatus] = None
        self.status_s = self.motion_s = -math.inf  # of 0x211: when its counter last went on
        self._counter, self._last_status_s = 0, -math.inf
        self._spec, self._profile = spec, profile
        self._motor_faults: Dict[int, List[str]] = {}

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Note a frame, unless it is not in the table or of a wrong length."""
        message = protocol.decode(can_id, data)
        if isinstance(message, SystemStatus):
            self.status = message
            self._count(message.counter, now_s)
        elif isinstance(message, MotionStatus):
            self.motion, self.motion_s = message, now_s
            self.note(message.speed_mps, now_s)
        elif isinstance(message, MotorSlow):
            self._motor_faults[can_id] = protocol.motor_faults(can_id, message)

    def _count(self, counter: int, now_s: float) -> None:
        """Take a status for a sign of life if its counter is ahead of all before, or after silence.

        Up to 127 ahead is newer: frames that are replayed lie behind, and do not count.
        """
        was_silent = now_s - self._last_status_s > STATUS_SILENCE_S
        if was_silent or 0 < (counter - self._counter) % COUNTERS < COUNTERS // 2:
            self._counter, self.status_s = counter, now_s
        self._last_status_s = now_s

    def is_known_to_stand(self, now_s: float) -> bool:
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
        """Return the errors that the chassis names, in words, without those of its operation."""
        words = protocol.status_faults(self.status, self._profile) if self.status else []
        return words + [word for motor in self._motor_faults.values() for word in motor]

    def silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        """Return SILENT where feedback is missing that was due since `since_s`."""
        if now_s - max(self.motion_s, since_s) > self.silence_s:
            return Finding(Fault.SILENT, "the chassis sends no 0x221")
        if now_s - max(self.status_s, since_s) > STATUS_SILENCE_S:
            repeats = now_s - self._last_status_s <= STATUS_SILENCE_S
            words = "repeats itself: the counter of 0x211 stands still"
            return Finding(Fault.SILENT, f"the chassis {words if repeats else 'sends no 0x211'}")
        return None

    def commander(self) -> Optional[Finding]:
        """Return what outranks us: the remote control, or the emergency stop."""
        if self.remote_drives:
            return Finding(VehicleEvent.REMOTE, "the remote control drives")
        if self.status is not None and self.status.state == protocol.STATE_ESTOP:
            return Finding(VehicleEvent.ESTOP, "the emergency stop is pressed")
        return None

    def finding(self) -> Optional[Finding]:
        """Return the gravest that stands between the chassis and our commands now."""
        status = self.status
        if status is None:
            return Finding(Fault.SILENT, "the chassis sends no 0x211")
        if outranked := self.commander():
            return outranked
        if errors := self.errors():
            return Finding(VehicleEvent.FAULT, ", ".join(errors))
        if status.state != protocol.STATE_OK:
            words = f"the chassis is in state {status.state} (exception)"
            return Finding(VehicleEvent.FAULT, words)
        if status.mode != protocol.CAN_CONTROL:
            name = "standby" if status.mode == protocol.STANDBY else f"mode {status.mode}"
            words = f"the chassis is in {name}, not under CAN control"
            return Finding(VehicleEvent.STANDBY, words)
        if status.brake:
            return Finding(VehicleEvent.LOCKED, "the chassis has locked its brake")
        return self.lie()

    def lie(self) -> Optional[Finding]:
        """Return LYING where it reports what the model cannot do."""
        words = impossible(*self.motion, self._spec) if self.motion else ""
        return Finding(Fault.LYING, f"the chassis reports {words}") if words else None


class HunterCore(StreamedCore):
    def __init__(self, similarity: Similarity, profile: str) -> None:
        self.reports = Reports(similarity.spec, profile)
        super().__init__(similarity, self.reports)
        self._ask_s = math.inf  # when to ask the chassis for something next
        self._bus_words = ""  # empty while it works
        self._bus_fails = Lasting()

    def enable(self, now_s: float) -> None:
        super().enable(now_s)
        self._ask_s = now_s

    def close(self, now_s: float) -> List[Sent]:
        """Return the last frames: stand, park, give control back; none if it was never taken."""
        if self.state is VehicleState.DISABLED:
            return []
        self._apply(Finding(VehicleEvent.CLOSE, ""), now_s)
        park = [] if self.reports.remote_drives else [_LOCK]
        return [self._motion(), *park, _GIVE_BACK]

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take a frame of the bus, from any sender; never raises."""
        if self.state is VehicleState.DISABLED:
            self.bus_works()  # nothing is sent then that it could take
        if can_id in protocol.COMMAND_IDS:
            words = f"somebody else sends 0x{can_id:x}"
            self._apply(Finding(VehicleEvent.FOREIGN, words), now_s)
            return
        self.reports.hear(can_id, data, now_s)
        if can_id == protocol.SYSTEM_STATUS.can_id or can_id in protocol.MOTOR_OF_SLOW:
            self._judge(now_s)
        elif can_id == protocol.MOTION_STATUS.can_id and (lie := self.reports.lie()):
            # At once, not with the next tick: else the runtime's own watch would stop it first,
            # and what it then says is over with the lie.
            self._apply(lie, now_s)

    def bus_failed(self, words: str, now_s: float, fatal: bool = False) -> None:
        """Note that the bus did not take a frame, or gave none; `fatal`: it says that it is off."""
        self._bus_fails.note(True, now_s)
        if fatal or now_s - self._bus_fails.since_s > BUS_PATIENCE_S:
            self._bus_words = f"the CAN bus fails: {words}"
            self._apply(Finding(VehicleEvent.BUS, self._bus_words), now_s)

    def bus_works(self) -> None:
        """Note that the bus took a frame, or (while none is sent) gave one."""
        self._bus_fails, self._bus_words = Lasting(), ""

    def tick(self, now_s: float) -> List[Sent]:
        """Return the frames to send now; none while DISABLED."""
        self._look(now_s)
        if self.state is VehicleState.DISABLED:
            return []
        parts = self._requests(now_s) if now_s >= self._ask_s else []
        self._step(now_s)
        return [*parts, self._motion()]

    def report(self, now_s: float) -> VehicleReport:
        status = self.reports.status
        return super().report(now_s)._replace(battery_v=status.battery_v if status else None)

    def is_at_rest(self, now_s: float) -> bool:
        """Return whether it is known to stand, or the bus is dead or the remote control drives."""
        is_blind = bool(self._bus_words) or self.reports.remote_drives
        is_off = self.state is VehicleState.DISABLED
        return is_off or is_blind or self.reports.is_known_to_stand(now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        before = self.state
        super()._apply(finding, now_s)
        if self.state is not before and self.state is VehicleState.STOPPED:
            at_once = finding.event is Fault.STUCK  # no set-point will stop it: the brake must
            self._ask_s = now_s + (0.0 if at_once else STOP_TAKES_S)
        elif self.state is VehicleState.ENABLED:
            self._ask_s = math.inf

    def _judge(self, now_s: float) -> None:
        """Apply what the chassis's newest status means."""
        if self.state is VehicleState.ENABLING and self.reports.status_s <= self._since_s:
            return  # from before it was asked
        self._apply(self.reports.finding() or Finding(VehicleEvent.CONFIRMED, ""), now_s)

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
        """Return what goes beside the stream: for control if ENABLING, for the brake if STOPPED."""
        self._ask_s = now_s + ASK_AGAIN_S
        if self.state is VehicleState.STOPPED:
            # A person with the remote control knows better than we do.
            is_over = self.reports.remote_drives or self.reports.is_known_to_stand(now_s)
            return [] if is_over else [_LOCK]
        return [*([_CLEAR] if self.reports.needs_clearing else []), _TAKE, _RELEASE]

    def _motion(self) -> Sent:
        return protocol.motion(self.set_point.speed_mps, self.set_point.inner_rad, self._spec)

    def _centre_rad(self) -> Optional[float]:
        motion = self.reports.motion
        return self._spec.centre_rad(motion.inner_steering_rad) if motion else None
