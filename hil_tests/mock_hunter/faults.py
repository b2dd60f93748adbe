"""Every fault that can be switched on: one row each. The names are those of ``--fault``."""

from __future__ import annotations

from typing import NamedTuple

from edge_runtime.util import UserError
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

BEHAVIOURS: dict[str, str] = {
    "silent": "it sends nothing, and obeys",
    "frozen": "it repeats its last frames, and obeys",
    "stuck": "its motors stay as they are, whatever is asked; its brake works",
    "lying": "it reports a speed that cannot be",
    "late": "all that it sends comes late",
    "bus_off": "it neither sends nor hears",
    "remote": "the remote control takes over, its sticks at rest",
    "estop": "its emergency stop is pressed",
}

FAULTS: dict[str, str] = {**BEHAVIOURS, **{name: bit.words for name, bit in BITS.items()}}
LATE_S = 0.4
LIE_MPS = 3.0


def check_fault(name: str) -> str:
    """The name. Raises UserError for one that is not known."""
    if name not in FAULTS:
        raise UserError(f"no fault {name!r}; choose from {', '.join(FAULTS)}")
    return name
