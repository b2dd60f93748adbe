"""The Hunter's CAN frames (protocol V2) and fault bits: tables, one encoder, one decoder. Pure.

CAN 2.0B with 11-bit identifiers, 500 kbit/s, big-endian, no checksum, by the maker's manual. All
frames go both ways here: the mock of the chassis speaks the other side.

Firmwares differ in the fault bits of 0x211, so the profile is a setting. A bit that the profile
does not know is a fault, too.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Dict, List, NamedTuple, Tuple, Type

from edge_runtime.vehicles.mapping import HunterSpec, clamp

BITRATE = 500_000

# Values of 0x421 (REMOTE_CONTROL aside) and of SystemStatus.mode; of 0x131 and .brake; of 0x441.
STANDBY, CAN_CONTROL, REMOTE_CONTROL = 0, 1, 2
RELEASE, LOCK = 0, 1
CLEAR_ALL = 0
# Values of SystemStatus.state.
STATE_OK, STATE_ESTOP, STATE_EXCEPTION = 0, 1, 2


class WheelMotion(NamedTuple):
    """0x111: the request, every 20 ms; the chassis times out after 500 ms. 0x221: the motion."""

    speed_mps: float
    inner_steering_rad: float


class ByteCommand(NamedTuple):
    """0x421: STANDBY or CAN_CONTROL. 0x131: RELEASE or LOCK. 0x441: CLEAR_ALL."""

    value: int


class SystemStatus(NamedTuple):
    """0x211. `faults` are bytes 4 (high) and 5 (low); PROFILES says what the bits mean."""

    state: int
    mode: int
    battery_v: float
    faults: int
    brake: int
    counter: int


class MotorFast(NamedTuple):
    """0x251 to 0x253 (steering, rear right, rear left): how it turns."""

    speed_rpm: int
    current_a: float
    pulses: int


class MotorSlow(NamedTuple):
    """0x261 to 0x263 (steering, rear right, rear left): the motor's driver and its health."""

    voltage_v: float
    driver_c: int
    motor_c: int
    status: int


class Frame(NamedTuple):
    """A row of the table.

    `layout` is a format of struct: a letter, without a count, for each field of the message, and x
    for bytes that are 0. `worth` is the value of one count of each field, 1 for an integer.
    """

    can_id: int
    message: Type[Any]
    layout: str
    worth: Tuple[float, ...]

    @property
    def length(self) -> int:
        return struct.calcsize(self.layout)

    def sent(self, message: Any) -> Sent:
        """Return the frame with the data of a message."""
        return Sent(self, encode(self, message))


class Sent(NamedTuple):
    frame: Frame
    data: bytes


_MILLI, _TENTH = 0.001, 0.1  # m/s, rad; V, A
_BYTE = (">B", (1,))
_MOTION = (">h4xh", (_MILLI, _MILLI))
_FAST = (">hhi", (1, _TENTH, 1))
_SLOW = (">HhbB2x", (_TENTH, 1, 1, 1))
_STATUS = (">BBHHBB", (1, 1, _TENTH, 1, 1, 1))

MOTION_COMMAND = Frame(0x111, WheelMotion, *_MOTION)
BRAKE_COMMAND = Frame(0x131, ByteCommand, *_BYTE)
MODE_COMMAND = Frame(0x421, ByteCommand, *_BYTE)
CLEAR_COMMAND = Frame(0x441, ByteCommand, *_BYTE)
SYSTEM_STATUS = Frame(0x211, SystemStatus, *_STATUS)
MOTION_STATUS = Frame(0x221, WheelMotion, *_MOTION)
_MOTORS = ("steering", "rear right", "rear left")
MOTORS_FAST = [Frame(0x251 + place, MotorFast, *_FAST) for place in range(3)]
MOTORS_SLOW = [Frame(0x261 + place, MotorSlow, *_SLOW) for place in range(3)]

COMMANDS: Tuple[Frame, ...] = (MOTION_COMMAND, BRAKE_COMMAND, MODE_COMMAND, CLEAR_COMMAND)
FEEDBACK: Tuple[Frame, ...] = (SYSTEM_STATUS, MOTION_STATUS, *MOTORS_FAST, *MOTORS_SLOW)
COMMAND_IDS = {frame.can_id for frame in COMMANDS}  # only we should send these
FRAMES: Dict[int, Frame] = {frame.can_id: frame for frame in COMMANDS + FEEDBACK}
MOTOR_OF_SLOW = {frame.can_id: motor for frame, motor in zip(MOTORS_SLOW, _MOTORS)}


def encode(frame: Frame, message: Any) -> bytes:
    """Return a message's data, clamped to what each field can hold; ValueError if not finite."""
    counts = []
    numbers = filter("bBhHi".__contains__, frame.layout)  # The other letters are padding.
    for code, worth, value in zip(numbers, frame.worth, message):
        if not math.isfinite(value):
            raise ValueError(f"{value} is no number for the bus")
        size = 2 ** (8 * struct.calcsize(f">{code}"))
        low = -size // 2 if code.islower() else 0
        counts.append(round(min(max(value / worth, low), low + size - 1)))
    return struct.pack(frame.layout, *counts)


def motion(speed_mps: float, inner_steering_rad: float, spec: HunterSpec) -> Sent:
    """Return 0x111 within the limits of the model. Raises ValueError for what is not finite."""
    speed_mps = clamp(speed_mps, spec.max_speed_mps)  # NaN passes, and encode refuses it
    inner_rad = clamp(inner_steering_rad, spec.max_inner_steering_rad)
    return MOTION_COMMAND.sent(WheelMotion(speed_mps, inner_rad))


def decode(can_id: int, data: bytes) -> Any:
    """Return the message of a frame; None for an identifier or length not in the table."""
    frame = FRAMES.get(can_id)
    if frame is None or len(data) != frame.length:
        return None
    counts = struct.unpack(frame.layout, data)
    return frame.message(*(count * worth for count, worth in zip(counts, frame.worth)))


# The chassis reports this while nobody streams: it is a fault only once we stream.
LINK_LOST = "link to the upper computer lost"
UNDERVOLTAGE = "battery undervoltage"
REMOTE_LOST = "remote control lost"
STEER_ENCODER = "steering encoder"
DRIVER = "motor driver"
LINK_STEER = "link to the steering motor lost"
LINK_REAR_RIGHT = "link to the rear right motor lost"
LINK_REAR_LEFT = "link to the rear left motor lost"
OVERTEMPERATURE = "overtemperature"
OVERCURRENT = "overcurrent"

PROFILES: Dict[str, Dict[int, str]] = {
    # The hardware facts' layout. A key is a bit of SystemStatus.faults: the high byte is byte 4.
    "v2": {
        0x0200: STEER_ENCODER,
        0x0400: REMOTE_LOST,
        0x1000: LINK_LOST,
        0x4000: DRIVER,
        0x0001: UNDERVOLTAGE,
        0x0008: LINK_STEER,
        0x0010: LINK_REAR_RIGHT,
        0x0020: LINK_REAR_LEFT,
        0x0040: OVERTEMPERATURE,
        0x0080: OVERCURRENT,
    },
    # Table 3.1 of the Hunter 2.0 user manual, page 7.
    "manual": {
        0x0100: DRIVER,
        0x0200: LINK_LOST,
        0x0001: UNDERVOLTAGE,
        0x0004: REMOTE_LOST,
        0x0008: LINK_STEER,
        0x0010: LINK_REAR_RIGHT,
        0x0020: LINK_REAR_LEFT,
        0x0080: STEER_ENCODER,
    },
}
DEFAULT_PROFILE = "v2"

# Bits 0 to 5 of byte 5 of 0x261 to 0x263; 6 and 7 (enabled, reset) are no faults.
DRIVER_FAULTS = {
    0x01: "supply voltage low",
    0x02: "motor overtemperature",
    0x04: "driver overcurrent",
    0x08: "driver overtemperature",
    0x10: "sensor",
    0x20: "driver",
}


def status_faults(status: SystemStatus, profile: str) -> List[str]:
    """Return the faults that 0x211 names, in words."""
    return [
        PROFILES[profile].get(1 << bit, f"unknown to {profile}: byte {5 - bit // 8} bit {bit % 8}")
        for bit in range(16)
        if status.faults & (1 << bit)
    ]


def motor_faults(can_id: int, motor: MotorSlow) -> List[str]:
    """Return the faults that 0x261 to 0x263 name, in words, with the motor's place."""
    known = [words for mask, words in DRIVER_FAULTS.items() if motor.status & mask]
    return [f"{MOTOR_OF_SLOW[can_id]} motor: {words}" for words in known]
