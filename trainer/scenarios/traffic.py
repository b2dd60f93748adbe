"""Surrounding traffic: types of vehicles, and highway-env's IDM within a lane.

The intelligent driver model is that of Treiber, Hennecke and Helbing (2000); in the congestion it
also controls the ego car's pedals. Cars are blind to the ego car unless they follow it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from highway_env.road.lane import StraightLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.utils import not_zero
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from trainer.scenarios.picture import Rectangle

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
    """Return the acceleration, m/s2, of a vehicle that is ``closing_mps`` faster than its leader.

    ``gap_m`` is bumper to bumper, infinite without a leader; ``time_gap_factor`` as in ``equip``.
    """
    a, b = kind.acceleration_mps2, kind.deceleration_mps2
    approach_m = speed_mps * closing_mps / (2.0 * math.sqrt(a * b))
    wanted_m = kind.standstill_gap_m + max(
        0.0, speed_mps * time_gap_factor * kind.time_gap_s + approach_m
    )
    free = 1.0 - (speed_mps / desired_mps) ** EXPONENT
    return a * (free - (wanted_m / max(gap_m, LEAST_GAP_M)) ** 2)


@dataclass(frozen=True)
class VehicleType:
    """Size and IDM parameters of one kind of vehicle."""

    length_m: float
    width_m: float
    acceleration_mps2: float  # Comfortable acceleration (IDM's a)
    deceleration_mps2: float  # Comfortable deceleration (IDM's b)
    time_gap_s: float  # Time gap to the leader (IDM's T)
    standstill_gap_m: float = 2.0  # Bumper to bumper at rest (IDM's s0)


CAR = VehicleType(5.0, 2.0, 3.0, 5.0, 0.8)
BUBBLE_CAR = replace(CAR, length_m=2.3, width_m=1.4)
SMALL_CAR = replace(CAR, length_m=3.6, width_m=1.65)
COMPACT_CAR = replace(CAR, length_m=4.3, width_m=1.8)
LARGE_CAR = replace(CAR, length_m=5.3, width_m=2.1)
VAN = VehicleType(6.5, 2.16, 2.6, 4.5, 1.0)
TRUCK = VehicleType(7.1, 2.4, 1.3, 4.0, 1.2)
MOTORCYCLE = VehicleType(2.2, 0.9, 6.0, 10.0, 0.6)

Mix = tuple[tuple[VehicleType, float], ...]  # Vehicle types and their shares, which sum to 1
CARS_ONLY: Mix = tuple((car, 0.2) for car in (BUBBLE_CAR, SMALL_CAR, COMPACT_CAR, CAR, LARGE_CAR))
"""Traffic of the nominal scenes."""
MIXED: Mix = ((CAR, 0.4), (VAN, 0.2), (TRUCK, 0.2), (MOTORCYCLE, 0.2))
"""Traffic of the variant scenes (section VII-D: more types and amounts of vehicles)."""


def draw_types(mix: Mix, count: int, random: np.random.Generator) -> list[VehicleType]:
    """Draw the types of ``count`` vehicles; a mix of one type draws nothing."""
    if len(mix) == 1:
        return [mix[0][0]] * count
    chosen = random.choice(len(mix), size=count, p=[share for _, share in mix])
    return [mix[number][0] for number in chosen]


def bodies_m(behind: VehicleType, ahead: VehicleType) -> float:
    """Return the distance of the centres of two vehicles that touch, bumper to bumper."""
    return 0.5 * (behind.length_m + ahead.length_m)


def equip(
    cars: list[TrafficVehicle], types: list[VehicleType], time_gap_factor: float = 1.0
) -> None:
    """Give each vehicle, after its leader, its type's size and IDM parameters.

    ``time_gap_factor``: share of the type's time gap; people close up in a jam.
    """
    for car, kind in zip(cars, types, strict=True):
        car.LENGTH, car.WIDTH = kind.length_m, kind.width_m
        car.COMFORT_ACC_MAX = kind.acceleration_mps2
        car.COMFORT_ACC_MIN = -kind.deceleration_mps2
        car.TIME_WANTED = time_gap_factor * kind.time_gap_s
        # highway-env's IDM takes distances from centre to centre.
        bodies = kind.length_m if car.leader is None else 0.5 * (car.LENGTH + car.leader.LENGTH)
        car.DISTANCE_WANTED = kind.standstill_gap_m + bodies


class TrafficVehicle(IDMVehicle):
    """An aggressive driver: keeps its lane, follows its leader closely, yields to nobody.

    Only the longitudinal half of ``IDMVehicle`` is used: a car in a straight lane needs no lane
    choice, and its leader never changes. That takes the neighbour search, most of the cost of a
    step, out of the loop. All lanes with traffic lead along x, so that a place is one number.
    """

    def __init__(
        self,
        road: Road,
        lane_index: LaneIndex,
        position_m: float,
        speed_mps: float,
        leader: Vehicle | None,
    ) -> None:
        lane = road.network.get_lane(lane_index)
        # Without a road at first: highway-env would search all lanes for the one named here.
        super().__init__(
            None, lane.position(position_m, 0.0), lane.heading_at(position_m), speed_mps,
            target_lane_index=lane_index, target_speed=speed_mps, enable_lane_change=False,
        )  # fmt: skip
        self.road, self.lane, self.lane_index = road, lane, lane_index
        self._start_m = float(lane.start[0])
        self.leader = leader

    def act(self, action: dict | str | None = None) -> None:
        """Choose the acceleration by the intelligent driver model; the wheels stay straight."""
        acceleration = min(max(self._wanted_mps2(), -self.ACC_MAX), self.ACC_MAX)
        self.action = {"steering": 0.0, "acceleration": acceleration}

    def _wanted_mps2(self) -> float:
        """``IDMVehicle.acceleration`` to the bit, on plain numbers: several times as fast."""
        a, speed = self.COMFORT_ACC_MAX, max(self.speed, 0.0)
        # numpy's power, as there: Python's differs in the last bit.
        wanted = a * (1.0 - float(np.power(speed / abs(not_zero(self.target_speed)), self.DELTA)))
        if self.leader is None:
            return wanted
        leader = self.leader
        closing_mps = self.speed - leader.speed * math.cos(leader.heading)
        approach_m = self.speed * closing_mps / (2.0 * math.sqrt(-a * self.COMFORT_ACC_MIN))
        gap_m = self.DISTANCE_WANTED + self.speed * self.TIME_WANTED + approach_m
        # Along the lane, each from its start.
        x, ahead_x = self.position.item(0), leader.position.item(0)
        share = gap_m / not_zero((ahead_x - self._start_m) - (x - self._start_m))
        return wanted - a * (share * share)

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds. A car that has braked to a stop stands: it never reverses."""
        acceleration = max(self.action["acceleration"], -self.speed / dt)
        self.position[0] += self.speed * dt
        self.speed += acceleration * dt


def footprint(car: Vehicle) -> Rectangle:
    x, y = car.position.tolist()
    return Rectangle(x, y, float(car.heading), car.LENGTH, car.WIDTH)


def straight_lanes(
    ends: tuple[str, str], start_m: float, end_m: float, middles_m: list[float], width_m: float
) -> RoadNetwork:
    """Make highway-env's lanes along x, side by side; ``middles_m`` are their y."""
    network = RoadNetwork()
    for y in middles_m:
        # No speed limit: the cars' own desired speeds are what limits them.
        lane = StraightLane((start_m, y), (end_m, y), width_m, speed_limit=None)
        network.add_lane(*ends, lane)
    return network


def queue(
    road: Road, lane_index: LaneIndex, positions_m: list[float], speeds_mps: list[float]
) -> list[TrafficVehicle]:
    """Put cars into a lane at falling distances along it; each follows the car before it.

    Each speed is a car's initial and desired one.
    """
    cars: list[TrafficVehicle] = []
    for position_m, speed_mps in zip(positions_m, speeds_mps, strict=True):
        leader = cars[-1] if cars else None
        cars.append(TrafficVehicle(road, lane_index, position_m, speed_mps, leader))
    return cars
