"""Surrounding traffic: highway-env's IDM, in its lane, blind to the ego car unless it follows it.

That IDM takes distances from centre to centre, which bounds its braking: a heavy vehicle close
behind one that stops at once runs into it. ``idm.py``, on the ego car's pedals, takes gaps between
bumpers.
"""

from __future__ import annotations

import math

import numpy as np
from highway_env.road.road import LaneIndex, Road
from highway_env.utils import not_zero
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from trainer.scenarios.geometry import Rectangle


class TrafficVehicle(IDMVehicle):
    """An aggressive driver: keeps its lane, follows its leader closely, yields to nobody.

    Only the longitudinal half of ``IDMVehicle`` is used: a car in a straight lane needs no lane
    choice, and its leader never changes. That takes the neighbour search, most of the cost of a
    step, out of the loop. All lanes with traffic lead along x, so that a place is one number.
    """

    DISTANCE_WANTED = 7.0
    """Desired distance to the leader at rest, centre to centre, m."""
    TIME_WANTED = 0.8
    """Desired time gap, s."""

    def __init__(
        self,
        road: Road,
        lane_index: LaneIndex,
        position_m: float,
        speed_mps: float,
        leader: Vehicle | None,
    ) -> None:
        lane = road.network.get_lane(lane_index)
        heading = lane.heading_at(position_m)
        # Without a road at first: highway-env would search all lanes for the one named here.
        super().__init__(
            None,
            lane.position(position_m, 0.0),
            heading=heading,
            speed=speed_mps,
            target_lane_index=lane_index,
            target_speed=speed_mps,
            enable_lane_change=False,
        )
        self.road, self.lane, self.lane_index = road, lane, lane_index
        self._direction = super().direction
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
        """Advance by ``dt`` seconds. Who has braked to a stop stands: nobody reverses."""
        acceleration = max(self.action["acceleration"], -self.speed / dt)
        self.position[0] += self.speed * dt
        self.speed += acceleration * dt

    def on_state_update(self) -> None:
        """Keep the lane: nothing to look up."""

    @property
    def direction(self) -> NDArray[np.float64]:
        """Where the car points, a unit vector [2]: always the same, as it never steers."""
        return self._direction

    @property
    def footprint(self) -> Rectangle:
        """The car's rectangle on the ground."""
        x, y = self.position.tolist()
        return Rectangle(x, y, float(self.heading), self.LENGTH, self.WIDTH)


def queue(
    road: Road,
    lane_index: LaneIndex,
    positions_m: list[float],
    speeds_mps: list[float],
) -> list[TrafficVehicle]:
    """Cars in one lane, the first leading; each follows the one before it.

    Args:
        road: the road they drive on (they are added to ``road.vehicles``).
        lane_index: their lane.
        positions_m: distances along the lane, falling.
        speeds_mps: initial and desired speed of each.
    """
    cars: list[TrafficVehicle] = []
    for position_m, speed_mps in zip(positions_m, speeds_mps, strict=True):
        leader = cars[-1] if cars else None
        cars.append(TrafficVehicle(road, lane_index, position_m, speed_mps, leader))
    road.vehicles.extend(cars)
    return cars
