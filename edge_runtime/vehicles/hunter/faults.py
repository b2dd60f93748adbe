"""The fault bits of the chassis in words: one table for each firmware profile. Pure.

Manuals of different firmware place the bits of 0x211 elsewhere, so that the profile is a setting.
A bit that the profile does not know is a fault as well: then the profile is not this firmware's.
"""

from __future__ import annotations

from typing import Dict, List, NamedTuple

from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.frames import MotorSlow, SystemStatus


class FaultBit(NamedTuple):
    """Byte 4 or 5 of 0x211, bit 0 to 7 of it, and what it means."""

    byte: int
    bit: int
    words: str

    @property
    def mask(self) -> int:
        """The bit within SystemStatus.faults."""
        return 1 << (self.bit + (8 if self.byte == 4 else 0))


# While nobody streams, the chassis misses its upper computer: only a fault once we stream.
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

PROFILES: Dict[str, List[FaultBit]] = {
    # The hardware facts' layout.
    "v2": [
        FaultBit(4, 1, STEER_ENCODER),
        FaultBit(4, 2, REMOTE_LOST),
        FaultBit(4, 4, LINK_LOST),
        FaultBit(4, 6, DRIVER),
        FaultBit(5, 0, UNDERVOLTAGE),
        FaultBit(5, 3, LINK_STEER),
        FaultBit(5, 4, LINK_REAR_RIGHT),
        FaultBit(5, 5, LINK_REAR_LEFT),
        FaultBit(5, 6, OVERTEMPERATURE),
        FaultBit(5, 7, OVERCURRENT),
    ],
    # Table 3.1 of the Hunter 2.0 user manual, page 7.
    "manual": [
        FaultBit(4, 0, DRIVER),
        FaultBit(4, 1, LINK_LOST),
        FaultBit(5, 0, UNDERVOLTAGE),
        FaultBit(5, 2, REMOTE_LOST),
        FaultBit(5, 3, LINK_STEER),
        FaultBit(5, 4, LINK_REAR_RIGHT),
        FaultBit(5, 5, LINK_REAR_LEFT),
        FaultBit(5, 7, STEER_ENCODER),
    ],
}
DEFAULT_PROFILE = "v2"

# Bits 0 to 5 of byte 5 of 0x261 to 0x263; 6 and 7 (enabled, reset) are no faults.
DRIVER_FAULTS = (
    "supply voltage low",
    "motor overtemperature",
    "driver overcurrent",
    "driver overtemperature",
    "sensor",
    "driver",
)


def status_faults(status: SystemStatus, profile: str) -> List[str]:
    """The faults that 0x211 names, in words; empty where it names none."""
    known = PROFILES[profile]
    words = [fault.words for fault in known if status.faults & fault.mask]
    for bit in range(16):
        mask = 1 << bit
        if status.faults & mask and not any(fault.mask == mask for fault in known):
            words.append(f"unknown to profile {profile}: byte {5 - bit // 8} bit {bit % 8}")
    return words


def fault_bits(words: str, profile: str) -> int:
    """The bits of SystemStatus.faults of a fault in words: what the mock sends."""
    return sum(fault.mask for fault in PROFILES[profile] if fault.words == words)


def motor_faults(can_id: int, motor: MotorSlow) -> List[str]:
    """The faults that 0x261 to 0x263 name, in words, with the motor's place."""
    place = frames.MOTOR_OF_SLOW[can_id]
    return [
        f"{place} motor: {words}"
        for bit, words in enumerate(DRIVER_FAULTS)
        if motor.status & (1 << bit)
    ]
