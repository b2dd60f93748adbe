"""What the chassis says of itself, as frames: (identifier, data). Pure."""

from __future__ import annotations

from typing import NamedTuple

from edge_runtime.vehicles.hunter import protocol as codec
from edge_runtime.vehicles.hunter.protocol import LINK_LOST, fault_bits
from hil_tests.mock_hunter.body import Body, curvature
from hil_tests.mock_hunter.chassis import Chassis, Condition, Control
from hil_tests.mock_hunter.faults import BITS, LIE_MPS, REAR_LEFT, REAR_RIGHT, STEERING
from hil_tests.mock_hunter.parameters import Parameters

_MODES = {
    Control.STANDBY: codec.STANDBY,
    Control.CAN: codec.CAN_CONTROL,
    Control.LINK_LOST: codec.STANDBY,
    Control.REMOTE: codec.REMOTE_CONTROL,
    Control.REMOTE_OVER_CAN: codec.REMOTE_CONTROL,
}
_STATES = {
    Condition.OK: codec.STATE_OK,
    Condition.ESTOP: codec.STATE_ESTOP,
    Condition.EXCEPTION: codec.STATE_EXCEPTION,
    Condition.ESTOP_AND_EXCEPTION: codec.STATE_ESTOP,
}
_FAST = {
    STEERING: codec.STEER_MOTOR_FAST,
    REAR_RIGHT: codec.REAR_RIGHT_FAST,
    REAR_LEFT: codec.REAR_LEFT_FAST,
}
_SLOW = {
    STEERING: codec.STEER_MOTOR_SLOW,
    REAR_RIGHT: codec.REAR_RIGHT_SLOW,
    REAR_LEFT: codec.REAR_LEFT_SLOW,
}
_ENABLED = 1 << 6
_COOL_C, _HOT_C = 35, 105
_INT32 = 2**32


class Reported(NamedTuple):
    """All that the frames are made of."""

    chassis: Chassis
    body: Body
    volts: float
    amperes: float
    counter: int
    lies: bool = False


def fast_frames(reported: Reported, parameters: Parameters) -> list[tuple[int, bytes]]:
    """0x221 and 0x251 to 0x253: every 20 ms."""
    body = reported.body
    speed_mps = body.speed_mps + (LIE_MPS if reported.lies else 0.0)
    motion = codec.MotionStatus(speed_mps, body.inner_rad)
    found = [_frame(codec.MOTION_STATUS, motion)]
    half = curvature(body.inner_rad, parameters) * parameters.track_m / 2
    for motor, way_m, share in (
        (REAR_RIGHT, body.right_m, 1 + half),
        (REAR_LEFT, body.left_m, 1 - half),
    ):
        turns = parameters.motor_revolutions_per_m
        rpm = round(body.speed_mps * share * turns * 60)
        pulses = way_m * turns * parameters.pulses_per_revolution
        fast = codec.MotorFast(rpm, reported.amperes / 2, _wrapped(pulses))
        found.append(_frame(_FAST[motor], fast))
    turns = parameters.steer_revolutions_per_rad
    rpm = round(body.steering_radps * turns * 60)
    pulses = body.inner_rad * turns * parameters.pulses_per_revolution
    return [*found, _frame(_FAST[STEERING], codec.MotorFast(rpm, 0.0, _wrapped(pulses)))]


def slow_frames(
    reported: Reported, parameters: Parameters, profile: str
) -> list[tuple[int, bytes]]:
    """0x211 and 0x261 to 0x263: every 100 ms."""
    found = [_frame(codec.SYSTEM_STATUS, status(reported, profile))]
    for motor, row in _SLOW.items():
        bits = _ENABLED | sum(
            BITS[error].motor_bits
            for error in reported.chassis.errors
            if motor in BITS[error].motors
        )
        hot = "overtemperature" in reported.chassis.errors and motor != STEERING
        celsius = _HOT_C if hot else _COOL_C
        found.append(_frame(row, codec.MotorSlow(reported.volts, celsius, celsius, bits)))
    return found


def status(reported: Reported, profile: str) -> codec.SystemStatus:
    """0x211: who drives, whether anybody may, the battery, the errors, the brake."""
    chassis = reported.chassis
    bits = sum(fault_bits(BITS[error].words, profile) for error in chassis.errors)
    if chassis.control is Control.LINK_LOST:
        bits |= fault_bits(LINK_LOST, profile)
    return codec.SystemStatus(
        state=_STATES[chassis.condition],
        mode=_MODES[chassis.control],
        battery_v=reported.volts,
        faults=bits,
        brake=int(chassis.brake_locked),
        counter=reported.counter % 256,
    )


def _frame(row: codec.Frame, message: object) -> tuple[int, bytes]:
    return row.can_id, codec.encode(row, message)


def _wrapped(pulses: float) -> int:
    """As a 32-bit counter shows it after it has run over."""
    return (round(pulses) + _INT32 // 2) % _INT32 - _INT32 // 2
