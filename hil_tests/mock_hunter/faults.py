"""Every fault that can be switched on: one row each. The names are those of ``--fault``."""

from __future__ import annotations

from typing import NamedTuple

from edge_runtime.errors import UserError


class Bit(NamedTuple):
    """An error that the chassis shows in 0x211.

    ``stops``: it then lets nobody drive. ``latches``: it stays until 0x441 clears it. Which do
    so the manual leaves open: assumed.
    """

    words: str
    stops: bool = True
    latches: bool = False


BITS: dict[str, Bit] = {
    "steering_encoder": Bit("the steering encoder fails", latches=True),
    "driver": Bit("a motor driver fails", latches=True),
    "undervoltage": Bit("the battery is nearly empty"),
    "link_steer": Bit("no link to the steering motor"),
    "link_rear_right": Bit("no link to the right rear motor"),
    "link_rear_left": Bit("no link to the left rear motor"),
    "overtemperature": Bit("a motor driver is too hot"),
    "overcurrent": Bit("a motor takes too much current", latches=True),
    "remote_lost": Bit("the remote control is out of reach", stops=False),
}

BEHAVIOURS: dict[str, str] = {
    "silent": "it sends nothing, and obeys",
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
