"""A scripted human for highway-env's racetrack: it keeps to a lane's middle and passes cars.

In a clone: ``python -m trainer train --scenario racetrack-v0 --human
examples.racetrack:RacetrackExpert --out runs/race``
"""

from typing import Any

import numpy as np
from highway_env.utils import wrap_to_pi

FULL_STEERING_RAD = np.pi / 4  # The front wheels' angle at action 1


class RacetrackExpert:
    """Drives from the true state, and takes over from a policy that leaves its lane."""

    AHEAD_S, CENTRE_PER_S, HEADING_PER_S, TOWARDS = 0.2, 1.0, 3.0, 0.35
    OFFSET_M, HEADING_RAD, ROOM_M = 1.6, 0.5, 17.0
    """Limits for the policy: offset from the middle, angle to the lane, distance to a car ahead (it
    sees 18 m ahead)."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def act(self) -> np.ndarray:
        car, lane = self.env.vehicle, self._lane()
        along_m, aside_m = lane.local_coordinates(car.position)
        speed_mps = max(car.speed, 1.0)
        towards = np.clip(-self.CENTRE_PER_S * aside_m / speed_mps, -self.TOWARDS, self.TOWARDS)
        wanted_rad = lane.heading_at(along_m + speed_mps * self.AHEAD_S) + np.arcsin(towards)
        rate = self.HEADING_PER_S * wrap_to_pi(wanted_rad - car.heading)
        slip_rad = np.arcsin(np.clip(0.5 * car.LENGTH * rate / speed_mps, -0.9, 0.9))
        angle_rad = np.arctan(2.0 * np.tan(slip_rad))
        return np.clip([angle_rad / FULL_STEERING_RAD], -1.0, 1.0)

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        """Return the reason to take over, or None, as where the policy steers like the expert."""
        if abs(float(policy_action[0]) - float(self.act()[0])) < 0.2:
            return None
        car, lane = self.env.vehicle, self._lane()
        along_m, aside_m = lane.local_coordinates(car.position)
        if lane is not car.lane:
            return "collision"
        if abs(wrap_to_pi(lane.heading_at(along_m) - car.heading)) > self.HEADING_RAD:
            return "heading"
        return "offset" if abs(aside_m) > self.OFFSET_M else None

    def _lane(self) -> Any:
        """Return the car's lane, or a free one beside it if that is not free."""
        car, network = self.env.vehicle, self.env.road.network
        lanes = [car.lane_index, *network.side_lanes(car.lane_index)]
        free = [index for index in lanes if self._is_free(network.get_lane(index))]
        return network.get_lane((free or lanes)[0])

    def _is_free(self, lane: Any) -> bool:
        car = self.env.vehicle
        along_m, _ = lane.local_coordinates(car.position)
        for other in self.env.road.vehicles:
            at_m, aside_m = lane.local_coordinates(other.position)
            near = -car.LENGTH < at_m - along_m < self.ROOM_M
            if other is not car and near and abs(aside_m) < 0.5 * lane.width_at(at_m):
                return False
        return True
