"""AgileX Hunter 2.0 and SE: the pure core, the CAN bus, and the driver that joins them.

`HunterCore` is pure: it hears every frame of the bus, and its `tick` returns the frames to send.
`HunterVehicle` puts two threads around it: the stream thread alone sends, until `close` has joined
it; the listener thread passes every frame to `hear`.

Nothing else in the runtime imports python-can, which a board without a CAN vehicle need not have.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import Any, ClassVar, Dict, List, Optional, Type

from edge_runtime import log
from edge_runtime.config import check_choice
from edge_runtime.util import UserError
from edge_runtime.vehicles import plausibility, streamed
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.protocol import MotorSlow, Sent, SystemStatus, WheelMotion
from edge_runtime.vehicles.mapping import HunterSpec, RobotSettings, Similarity
from edge_runtime.vehicles.plausibility import Fault, Finding
from edge_runtime.vehicles.streamed import STOP_TAKES_S, VehicleEvent, VehicleState

STATUS_SILENCE_S = 0.3  # three frames of 0x211; 0x221 comes five times as often
COUNTERS = 256  # byte 7 of 0x211 wraps around
ASK_AGAIN_S = 0.1  # a frame may be lost, and the chassis answers every 100 ms
BUS_PATIENCE_S = 0.1  # five frames of the stream
REMOTE_DRIVES, ESTOP_PRESSED = "the remote control drives", "the emergency stop is pressed"

_TAKE = protocol.MODE_COMMAND.sent(protocol.ByteCommand(protocol.CAN_CONTROL))
_GIVE_BACK = protocol.MODE_COMMAND.sent(protocol.ByteCommand(protocol.STANDBY))
_RELEASE = protocol.BRAKE_COMMAND.sent(protocol.ByteCommand(protocol.RELEASE))
_LOCK = protocol.BRAKE_COMMAND.sent(protocol.ByteCommand(protocol.LOCK))
_CLEAR = protocol.CLEAR_COMMAND.sent(protocol.ByteCommand(protocol.CLEAR_ALL))


class Reports(streamed.Speeds):
    """The newest frame of each kind."""

    def __init__(self, spec: HunterSpec, profile: str) -> None:
        super().__init__()
        self.status: Optional[SystemStatus] = None
        self.motion: Optional[WheelMotion] = None
        self.status_s = self.motion_s = -math.inf  # of 0x211: when its counter last went on
        self._counter, self._last_status_s = 0, -math.inf
        self._spec, self._profile = spec, profile
        self._motor_faults: Dict[int, List[str]] = {}

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Note a frame; ignore an unknown identifier or a wrong length."""
        message = protocol.decode(can_id, data)
        if isinstance(message, SystemStatus):
            was_silent = now_s - self._last_status_s > STATUS_SILENCE_S
            self.status, self._last_status_s = message, now_s
            # Up to 127 ahead is newer; replayed frames lie behind, and do not show a live chassis.
            ahead = (message.counter - self._counter) % COUNTERS
            if was_silent or 0 < ahead < COUNTERS // 2:
                self._counter, self.status_s = message.counter, now_s
        elif isinstance(message, WheelMotion):
            self.motion, self.motion_s = message, now_s
            self.note(message.speed_mps, now_s)
        elif isinstance(message, MotorSlow):
            self._motor_faults[can_id] = protocol.motor_faults(can_id, message)

    def is_known_to_stand(self, now_s: float) -> bool:
        return self.stands and now_s - self.motion_s <= self.silence_s

    @property
    def needs_clearing(self) -> bool:
        """Whether it shows an error to clear; a lost link ends with the stream's first frame."""
        is_exception = self.status is not None and self.status.state == protocol.STATE_EXCEPTION
        return is_exception or bool({*self._errors()} - {protocol.LINK_LOST})

    @property
    def remote_drives(self) -> bool:
        """Whether the newest status shows remote control."""
        return self.status is not None and self.status.mode == protocol.REMOTE_CONTROL

    def _errors(self) -> List[str]:
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

    def finding(self) -> Optional[Finding]:
        """Return the gravest reason why the chassis does not follow commands now; None if none."""
        status = self.status
        if status is None:
            return Finding(Fault.SILENT, "the chassis sends no 0x211")
        if status.mode == protocol.REMOTE_CONTROL:
            return Finding(VehicleEvent.REMOTE, REMOTE_DRIVES)
        if status.state == protocol.STATE_ESTOP:
            return Finding(VehicleEvent.ESTOP, ESTOP_PRESSED)
        if errors := self._errors():
            return Finding(VehicleEvent.FAULT, ", ".join(errors))
        if status.state != protocol.STATE_OK:
            return Finding(VehicleEvent.FAULT, f"the chassis is in state {status.state}")
        if status.mode != protocol.CAN_CONTROL:
            words = f"the chassis is in mode {status.mode}, not under CAN control"
            return Finding(VehicleEvent.STANDBY, words)
        if status.brake:
            return Finding(VehicleEvent.LOCKED, "the chassis has locked its brake")
        return self.lie()

    def lie(self) -> Optional[Finding]:
        """Return LYING where it reports what the model cannot do."""
        words = plausibility.impossible(*self.motion, self._spec) if self.motion else ""
        return Finding(Fault.LYING, f"the chassis reports {words}") if words else None


class HunterCore(streamed.StreamedCore):
    def __init__(self, similarity: Similarity, profile: str) -> None:
        self.reports = Reports(similarity.spec, profile)
        super().__init__(similarity, self.reports)
        self._ask_s = math.inf  # when to ask the chassis for something next
        self._bus_fails_since_s = math.inf
        self._bus_words = ""  # empty while it works

    def enable(self, now_s: float) -> None:
        super().enable(now_s)
        self._ask_s = now_s

    def close(self, now_s: float) -> List[Sent]:
        """Return the last frames: stand, park, give control back; none if it was never taken."""
        if self.state is VehicleState.DISABLED:
            return []
        self._apply(Finding(VehicleEvent.CLOSE), now_s)
        park = [] if self.reports.remote_drives else [_LOCK]
        return [self._motion(), *park, _GIVE_BACK]

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take a frame of the bus, from any sender; never raises."""
        if self.state is VehicleState.DISABLED:
            self.bus_works()  # nothing is sent that could show it
        if can_id in protocol.COMMAND_IDS:
            words = f"somebody else sends 0x{can_id:x}"
            self._apply(Finding(VehicleEvent.FOREIGN, words), now_s)
            return
        self.reports.hear(can_id, data, now_s)
        if can_id == protocol.SYSTEM_STATUS.can_id or can_id in protocol.MOTOR_OF_SLOW:
            is_older = self.reports.status_s <= self._since_s  # from before `enable`
            if self.state is not VehicleState.ENABLING or not is_older:
                finding = self.reports.finding()
                self._apply(finding or Finding(VehicleEvent.CONFIRMED), now_s)
        elif can_id == protocol.MOTION_STATUS.can_id and (lie := self.reports.lie()):
            # At once, not with the next tick: otherwise the runtime's own watch stops the vehicle
            # first, and its reason ends with the lie.
            self._apply(lie, now_s)

    def bus_failed(self, words: str, now_s: float, fatal: bool = False) -> None:
        """Note that the bus failed to send or to receive; `fatal`: it reports bus-off."""
        self._bus_fails_since_s = min(self._bus_fails_since_s, now_s)
        if fatal or now_s - self._bus_fails_since_s > BUS_PATIENCE_S:
            self._bus_words = f"the CAN bus fails: {words}"
            self._apply(Finding(VehicleEvent.BUS, self._bus_words), now_s)

    def bus_works(self) -> None:
        """Note that the bus sent a frame, or (while none is sent) received one."""
        self._bus_fails_since_s, self._bus_words = math.inf, ""

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
        """Return whether it is known to stand, or is out of reach (dead bus, remote control)."""
        is_out = self.state is VehicleState.DISABLED or bool(self._bus_words)
        return is_out or self.reports.remote_drives or self.reports.is_known_to_stand(now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        before = self.state
        super()._apply(finding, now_s)
        if self.state is not before and self.state is VehicleState.STOPPED:
            at_once = finding.event is Fault.STUCK  # set-points do not stop it: the brake must
            self._ask_s = now_s + (0.0 if at_once else STOP_TAKES_S)
        elif self.state is VehicleState.ENABLED:
            self._ask_s = math.inf

    def standing(self, now_s: float) -> List[str]:
        if self._has_asked:
            return []
        finding = self.reports.finding()
        outranks = finding and finding.event in (VehicleEvent.REMOTE, VehicleEvent.ESTOP)
        words = [finding.words] if finding and outranks else []
        return words + super().standing(now_s) + ([self._bus_words] if self._bus_words else [])

    def _hindrance(self, now_s: float) -> Optional[Finding]:
        return super()._hindrance(now_s) or self.reports.finding()

    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        return self.reports.silence(since_s, now_s)

    def _requests(self, now_s: float) -> List[Sent]:
        """Return the frames beside the stream: take control if ENABLING, lock if STOPPED."""
        self._ask_s = now_s + ASK_AGAIN_S
        if self.state is VehicleState.STOPPED:
            # A person with the remote control knows better than we do.
            is_over = self.reports.remote_drives or self.reports.is_known_to_stand(now_s)
            return [] if is_over else [_LOCK]
        return [*([_CLEAR] if self.reports.needs_clearing else []), _TAKE, _RELEASE]

    def _motion(self) -> Sent:
        asked = self.set_point
        return protocol.motion(asked.speed_mps, asked.inner_rad, asked.spec)

    def _centre_rad(self) -> Optional[float]:
        motion = self.reports.motion
        return self._spec.centre_rad(motion.inner_steering_rad) if motion else None


DEFAULT_BUS = "socketcan:can0"
UDP = "udp_multicast"
MULTICAST_GROUP = "239.74.163.2"  # python-can's own
# Two buses need two ports: Linux delivers the packets of any group to every socket of the port.
MULTICAST_BUS = f"{UDP}:{MULTICAST_GROUP}:43113"
_LISTEN_S, _JOIN_S = 0.1, 0.5
_ERROR_BUS_OFF = 0x40  # of SocketCAN's error frames (linux/can/error.h)


def parse_bus(text: str) -> Dict[str, Any]:
    """Parse INTERFACE:CHANNEL, or udp_multicast:GROUP:PORT, for python-can. Raises UserError."""
    interface, _, channel = text.partition(":")
    group, _, port = channel.partition(":")
    if interface == UDP and port.isdecimal():
        options = {"port": int(port), "hop_limit": 0, "fd": False}  # no frame leaves the machine
        return {"interface": interface, "channel": group, **options}
    if interface not in ("", UDP) and channel:
        sets_bitrate = interface not in ("socketcan", "virtual")
        bitrate = {"bitrate": protocol.BITRATE} if sets_bitrate else {}
        return {"interface": interface, "channel": channel, **bitrate}
    raise UserError(f"bus {text!r} is not valid: write it as {DEFAULT_BUS} or {MULTICAST_BUS}")


def open_bus(bus: Dict[str, Any]) -> Any:
    """Open a python-can bus; send nothing. Raises UserError."""
    # Its backends complain on stderr; our one-line error covers that.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        import can
    except ImportError:
        words = "the hunter needs python-can, which is not installed: pip install python-can"
        raise UserError(words) from None
    try:
        return can.Bus(**bus)
    except Exception as error:  # each backend raises what its library raises, NameError included
        words = f"the CAN bus {bus['interface']}:{bus['channel']} cannot be opened: {error!r}"
        raise UserError(f"{words}; is it up, with a route (`ip link`, `ip route`)?") from None


class HunterSettings(RobotSettings, frozen=True, kw_only=True):
    """[vehicle.hunter]: its bus, and a row of protocol.PROFILES."""

    bus: str = DEFAULT_BUS
    profile: str = protocol.DEFAULT_PROFILE

    def __post_init__(self) -> None:
        parse_bus(self.bus)
        check_choice("vehicle.hunter.profile", self.profile, tuple(protocol.PROFILES))


class HunterVehicle(streamed.StreamedVehicle):
    """Opens its bus when made (UserError where it cannot), and sends nothing before `enable`."""

    name: ClassVar[str] = "hunter"
    settings_type: ClassVar[Type[RobotSettings]] = HunterSettings
    outranked_by: ClassVar[Dict[str, str]] = {
        "remote_control": REMOTE_DRIVES, "emergency_stop": ESTOP_PRESSED,
    }  # fmt: skip

    def __init__(self, settings: HunterSettings, similarity: Similarity) -> None:
        bus = parse_bus(settings.bus)
        self._bus: Any = open_bus(bus)
        # UDP multicast returns our own frames: a command there need not be somebody else's.
        self._ignores_commands = bus["interface"] == UDP
        self._core: HunterCore
        super().__init__(HunterCore(similarity, settings.profile))
        self._listener = threading.Thread(target=self._listen, name="hunter-listener", daemon=True)
        self._stream.start()
        self._listener.start()

    def _leave(self) -> None:
        """Lock the brake, give control back, and leave the bus."""
        self._listener.join(_JOIN_S)
        with self._lock:
            parts = self._core.close(time.monotonic())
        if parts and not self._send(parts):
            log.event("warning", "hunter_not_parked")  # it stops by itself
        self._bus.shutdown()

    def _send_due(self) -> bool:
        with self._lock:
            parts = self._core.tick(time.monotonic())
        if not (parts and self._send(parts)):
            return False
        with self._lock:
            self._core.bus_works()
        return True

    def _send(self, parts: List[Sent]) -> bool:
        import can

        try:
            for frame, data in parts:
                if frame not in protocol.COMMANDS:
                    raise RuntimeError(f"0x{frame.can_id:x} is no command of ours")
                message = can.Message(arbitration_id=frame.can_id, data=data, is_extended_id=False)
                # Not None: the virtual bus would wait for ever where a receiver's queue is full.
                self._bus.send(message, timeout=0.0)
        except Exception as error:  # CanError, OSError, or what else a backend raises
            self._note_bus(error)
            return False
        return True

    def _listen(self) -> None:
        while not self._ending:
            try:
                message = self._bus.recv(_LISTEN_S)
            except Exception as error:  # as in _send; it may raise at once, again and again
                self._note_bus(error)
                time.sleep(streamed.PERIOD_S)
                continue
            if message is not None:
                self._hear(message)

    def _hear(self, message: Any) -> None:
        if message.is_error_frame:
            if message.arbitration_id & _ERROR_BUS_OFF:
                self._note_bus("bus-off", fatal=True)
            return
        echoes = self._ignores_commands and message.arbitration_id in protocol.COMMAND_IDS
        if message.is_extended_id or message.is_remote_frame or message.is_fd or echoes:
            return  # no frame of this protocol, or our own
        with self._lock:
            was = self._core.state
            self._core.hear(message.arbitration_id, bytes(message.data), time.monotonic())
            stopped = self._core.state is VehicleState.STOPPED and was is not VehicleState.STOPPED
        if stopped:
            self._wake.set()

    def _note_bus(self, error: object, fatal: bool = False) -> None:
        with self._lock:
            self._core.bus_failed(str(error), time.monotonic(), fatal)
