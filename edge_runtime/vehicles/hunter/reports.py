"""What was heard of the chassis, and which event of the state machine it is. No clock, no bus."""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional

from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.faults import LINK_LOST, motor_faults, status_faults
from edge_runtime.vehicles.hunter.frames import MotionStatus, MotorSlow, SystemStatus
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.hunter.states import Event
from edge_runtime.vehicles.speeds import IMPOSSIBLE, Speeds
from edge_runtime.wire import CONTROL_PERIOD_S

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
        decoded = frames.decode(can_id, data)
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
        is_exception = self.status is not None and self.status.state == frames.STATE_EXCEPTION
        return is_exception or bool(set(self.errors()) - {LINK_LOST})

    @property
    def remote_drives(self) -> bool:
        """Whether the remote control had the vehicle when it was last heard."""
        return self.status is not None and self.status.mode == frames.REMOTE_CONTROL

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
        if self.status is not None and self.status.state == frames.STATE_ESTOP:
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
        if status.state != frames.STATE_OK:
            return Finding(Event.FAULT, f"the chassis is in state {status.state} (exception)")
        if status.mode != frames.CAN_CONTROL:
            name = "standby" if status.mode == frames.STANDBY else f"mode {status.mode}"
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
