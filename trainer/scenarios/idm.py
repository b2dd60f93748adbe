"""The intelligent driver model on the ego car's pedals (Treiber, Hennecke and Helbing, 2000)."""

from __future__ import annotations

import math

from trainer.scenarios.vehicle_types import VehicleType

EXPONENT = 4.0
LEAST_GAP_M = 0.1
"""A gap is taken to be at least this; one that closes to nothing is a crash anyway."""


def idm_acceleration(
    kind: VehicleType,
    speed_mps: float,
    desired_mps: float,
    gap_m: float = math.inf,
    closing_mps: float = 0.0,
    time_gap_factor: float = 1.0,
) -> float:
    """The acceleration in m/s2.

    Args:
        kind: the vehicle's parameters.
        speed_mps: its speed.
        desired_mps: its speed on a free road.
        gap_m: to the leader, bumper to bumper; infinite without one.
        closing_mps: how much faster it is than the leader.
        time_gap_factor: see ``vehicle_types.equip``.
    """
    a, b = kind.acceleration_mps2, kind.deceleration_mps2
    approach_m = speed_mps * closing_mps / (2.0 * math.sqrt(a * b))
    wanted_m = kind.standstill_gap_m + max(
        0.0, speed_mps * time_gap_factor * kind.time_gap_s + approach_m
    )
    free = 1.0 - (speed_mps / desired_mps) ** EXPONENT
    return a * (free - (wanted_m / max(gap_m, LEAST_GAP_M)) ** 2)
