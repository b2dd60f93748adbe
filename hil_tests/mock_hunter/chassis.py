"""The chassis's rules: (state, event, time) to state, and every fault that can be switched on.

CONTROL says who drives, CONDITION whether anybody may; every transition is a row of one of them.
The manual leaves open what follows when the remote control or the emergency stop lets go: here
the chassis then goes back to where it was, which gives control back by itself. That is the worst
case for whoever commands it, as its answer to frames that come back after a timeout is (and that
one is documented). No clock, no bus, no body.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from edge_runtime.vehicles.hunter import protocol as words

STEERING, REAR_RIGHT, REAR_LEFT = range(3)
_LOW_SUPPLY, _MOTOR_HOT, _OVERCURRENT = 1 << 0, 1 << 1, 1 << 2
_DRIVER_HOT, _SENSOR, _DRIVER = 1 << 3, 1 << 4, 1 << 5


class Bit(NamedTuple):
    """An error that the chassis shows in 0x211, by the driver's words for it.

    ``stops``: it then lets nobody drive. ``latches``: it stays until 0x441 clears it. Which do
    so the manual leaves open: assumed. ``motors`` show ``motor_bits`` in 0x261 to 0x263.
    """

    words: str
    stops: bool = True
    latches: bool = False
    motors: tuple[int, ...] = ()
    motor_bits: int = 0


BITS: dict[str, Bit] = {
    "steering_encoder": Bit(
        words.STEER_ENCODER, latches=True, motors=(STEERING,), motor_bits=_SENSOR
    ),
    "driver": Bit(words.DRIVER, latches=True, motors=(REAR_RIGHT,), motor_bits=_DRIVER),
    "undervoltage": Bit(
        words.UNDERVOLTAGE, motors=(STEERING, REAR_RIGHT, REAR_LEFT), motor_bits=_LOW_SUPPLY
    ),
    "link_steer": Bit(words.LINK_STEER),
    "link_rear_right": Bit(words.LINK_REAR_RIGHT),
    "link_rear_left": Bit(words.LINK_REAR_LEFT),
    "overtemperature": Bit(
        words.OVERTEMPERATURE, motors=(REAR_RIGHT, REAR_LEFT), motor_bits=_DRIVER_HOT | _MOTOR_HOT
    ),
    "overcurrent": Bit(
        words.OVERCURRENT, latches=True, motors=(REAR_RIGHT,), motor_bits=_OVERCURRENT
    ),
    "remote_lost": Bit(words.REMOTE_LOST, stops=False),
}

FAULTS: dict[str, str] = {
    "silent": "it sends nothing, and obeys",
    "frozen": "it repeats its last frames, and obeys",
    "stuck": "its motors stay as they are, whatever is asked; its brake works",
    "full_lock": "its wheels go to full lock, whatever is asked",
    "lying": "it reports a speed that cannot be",
    "late": "all that it sends comes late",
    "bus_off": "it neither sends nor hears",
    "remote": "the remote control takes over, its sticks at rest",
    "estop": "its emergency stop is pressed",
    **{name: bit.words for name, bit in BITS.items()},
}
LATE_S = 0.4
LIE_MPS = 3.0


class Control(StrEnum):
    """Who drives. ``*_OVER_CAN``: the bus had control and gets it back."""

    STANDBY = "standby"
    CAN = "can"
    LINK_LOST = "link_lost"  # standby, for the commands stopped coming
    REMOTE = "remote"
    REMOTE_OVER_CAN = "remote_over_can"


class ChassisCondition(StrEnum):
    """Whether anybody may drive."""

    OK = "ok"
    ESTOP = "estop"
    EXCEPTION = "exception"
    ESTOP_AND_EXCEPTION = "estop_and_exception"


class ChassisEvent(StrEnum):
    """What can happen. The first three are frames of the bus."""

    CAN_MODE = "0x421 = 1"
    STANDBY_MODE = "0x421 = 0"
    COMMAND = "0x111"
    TIMEOUT = "no 0x111 for 500 ms"
    REMOTE_ON = "remote control takes over"
    REMOTE_OFF = "remote control lets go"
    ESTOP_ON = "emergency stop pressed"
    ESTOP_OFF = "emergency stop released"
    ERRORS = "an error that stops it"
    ERRORS_OVER = "no error left that stops it"


_S, _C, _L, _R, _O = Control
CONTROL: dict[ChassisEvent, tuple[Control, ...]] = {
    # in:               standby, can, link_lost, remote, remote_over_can
    ChassisEvent.CAN_MODE:     (_C, _C, _C, _R, _O),  # the remote control always outranks the bus
    ChassisEvent.STANDBY_MODE: (_S, _S, _S, _R, _R),
    ChassisEvent.COMMAND:      (_S, _C, _C, _R, _O),  # the trap: link_lost, and nobody asked
    ChassisEvent.TIMEOUT:      (_S, _L, _L, _R, _O),
    ChassisEvent.REMOTE_ON:    (_R, _O, _O, _R, _O),
    ChassisEvent.REMOTE_OFF:   (_S, _C, _L, _S, _C),
}  # fmt: skip
"""ChassisEvent -> the state after it, for each state before it in the order of `Control`."""

_K, _E, _X, _B = ChassisCondition
CONDITION: dict[ChassisEvent, tuple[ChassisCondition, ...]] = {
    # in:               ok, estop, exception, estop_and_exception
    ChassisEvent.ESTOP_ON:     (_E, _E, _B, _B),
    ChassisEvent.ESTOP_OFF:    (_K, _K, _X, _X),
    ChassisEvent.ERRORS:       (_X, _B, _X, _B),
    ChassisEvent.ERRORS_OVER:  (_K, _E, _K, _E),
}  # fmt: skip


class Chassis(NamedTuple):
    """Where the chassis stands. Power-on: standby, brake locked, no error.

    ``causes`` are the errors whose cause is there now, ``errors`` those that it shows: some stay
    after their cause until they are cleared.
    """

    control: Control = Control.STANDBY
    condition: ChassisCondition = ChassisCondition.OK
    brake_locked: bool = True
    commanded_s: float = float("-inf")  # When the newest 0x111 came, or CAN control was taken
    causes: frozenset[str] = frozenset()
    errors: frozenset[str] = frozenset()


def advance(chassis: Chassis, event: ChassisEvent) -> Chassis:
    if event in CONTROL:
        return chassis._replace(control=CONTROL[event][list(Control).index(chassis.control)])
    place = list(ChassisCondition).index(chassis.condition)
    return chassis._replace(condition=CONDITION[event][place])


def take_can_mode(chassis: Chassis, now_s: float) -> Chassis:
    """Take 0x421 = 1: the time-out counts from the moment in which control changes hands."""
    after = advance(chassis, ChassisEvent.CAN_MODE)
    taken = after.control is Control.CAN and chassis.control is not Control.CAN
    return after._replace(commanded_s=now_s) if taken else after


def take_command(chassis: Chassis, now_s: float) -> Chassis:
    """Take 0x111: note it whoever drives; it is obeyed where `obeys` says so."""
    return advance(chassis, ChassisEvent.COMMAND)._replace(commanded_s=now_s)


def take_time(chassis: Chassis, now_s: float, timeout_s: float) -> Chassis:
    """Let time pass: the link counts as lost after ``timeout_s`` without a command."""
    late = now_s - chassis.commanded_s > timeout_s
    return advance(chassis, ChassisEvent.TIMEOUT) if late else chassis


def take_cause(chassis: Chassis, name: str, present: bool) -> Chassis:
    """Let the cause of an error come or go; an error that does not latch goes with it."""
    causes = chassis.causes | {name} if present else chassis.causes - {name}
    kept = {error for error in chassis.errors if BITS[error].latches or error in causes}
    return _settle(chassis._replace(causes=causes, errors=causes | kept))


def take_clear(chassis: Chassis) -> Chassis:
    """Take 0x441: forget every error whose cause is gone."""
    return _settle(chassis._replace(errors=chassis.causes))


def obeys(chassis: Chassis) -> bool:
    """Return whether the body follows the set-point of the bus."""
    return (
        chassis.control is Control.CAN
        and chassis.condition is ChassisCondition.OK
        and not chassis.brake_locked
    )


def _settle(chassis: Chassis) -> Chassis:
    stopped = any(BITS[error].stops for error in chassis.errors)
    return advance(chassis, ChassisEvent.ERRORS if stopped else ChassisEvent.ERRORS_OVER)
