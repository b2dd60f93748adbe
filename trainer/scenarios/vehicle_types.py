"""Who drives in the traffic: cars, and in the variant scenes vans, trucks and motorcycles too.

Cars come in five sizes of the range of CARLA's, whose earlier releases have a bubble car, too: a
policy that only ever saw one outline takes any other vehicle for something new. Vans, trucks and
motorcycles have the default sizes of Eclipse SUMO's vehicle classes delivery, truck and motorcycle
("Vehicle Type Parameter Defaults"); ``CAR`` is highway-env's own. Accelerations are of the order of
SUMO's; they and the time gaps are chosen: the heavier, the more sluggish and the longer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trainer.scenarios.traffic import TrafficVehicle


@dataclass(frozen=True)
class VehicleType:
    """Size and IDM parameters of one kind of vehicle."""

    name: str
    length_m: float
    width_m: float
    acceleration_mps2: float
    """Comfortable acceleration (IDM's a)."""
    deceleration_mps2: float
    """Comfortable deceleration (IDM's b)."""
    time_gap_s: float
    """Time gap to the leader (IDM's T)."""
    standstill_gap_m: float = 2.0
    """Bumper to bumper at rest (IDM's s0)."""


CAR = VehicleType("car", 5.0, 2.0, 3.0, 5.0, 0.8)
BUBBLE_CAR = replace(CAR, name="bubble car", length_m=2.3, width_m=1.4)
SMALL_CAR = replace(CAR, name="small car", length_m=3.6, width_m=1.65)
COMPACT_CAR = replace(CAR, name="compact car", length_m=4.3, width_m=1.8)
LARGE_CAR = replace(CAR, name="large car", length_m=5.3, width_m=2.1)
VAN = VehicleType("van", 6.5, 2.16, 2.6, 4.5, 1.0)
TRUCK = VehicleType("truck", 7.1, 2.4, 1.3, 4.0, 1.2)
MOTORCYCLE = VehicleType("motorcycle", 2.2, 0.9, 6.0, 10.0, 0.6)

Mix = tuple[tuple[VehicleType, float], ...]
"""Vehicle types and their shares, which sum to 1."""
CARS_ONLY: Mix = tuple((car, 0.2) for car in (BUBBLE_CAR, SMALL_CAR, COMPACT_CAR, CAR, LARGE_CAR))
"""Traffic of the nominal scenes."""
MIXED: Mix = ((CAR, 0.4), (VAN, 0.2), (TRUCK, 0.2), (MOTORCYCLE, 0.2))
"""Traffic of the variant scenes (section VII-D: more types and amounts of vehicles)."""


def draw_types(mix: Mix, count: int, random: np.random.Generator) -> list[VehicleType]:
    """The types of ``count`` vehicles; a mix of one type takes nothing from ``random``."""
    if len(mix) == 1:
        return [mix[0][0]] * count
    chosen = random.choice(len(mix), size=count, p=[share for _, share in mix])
    return [mix[number][0] for number in chosen]


def bodies_m(behind: VehicleType, ahead: VehicleType) -> float:
    """Centre to centre of two vehicles that touch, bumper to bumper."""
    return 0.5 * (behind.length_m + ahead.length_m)


def equip(
    cars: list[TrafficVehicle], types: list[VehicleType], time_gap_factor: float = 1.0
) -> None:
    """Give each vehicle its type's size and IDM parameters.

    Args:
        cars: vehicles, each with its leader.
        types: the type of each.
        time_gap_factor: share of the type's time gap that is kept; people close up in a jam.
    """
    for car, kind in zip(cars, types, strict=True):
        car.LENGTH, car.WIDTH = kind.length_m, kind.width_m
        car.COMFORT_ACC_MAX = kind.acceleration_mps2
        car.COMFORT_ACC_MIN = -kind.deceleration_mps2
        car.TIME_WANTED = time_gap_factor * kind.time_gap_s
    for car, kind in zip(cars, types, strict=True):
        # highway-env's IDM takes distances from centre to centre.
        bodies = kind.length_m if car.leader is None else 0.5 * (car.LENGTH + car.leader.LENGTH)
        car.DISTANCE_WANTED = kind.standstill_gap_m + bodies
