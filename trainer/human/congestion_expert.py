"""The scripted expert of the congestion: keeps the middle of the gap, from the true state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trainer.scenarios.congestion import CongestionEnv
from trainer.scenarios.environment import Observation


class CongestionExpert:
    """Heading control towards the middle between the neighbours to the left and to the right.

    A cascade: the offset from the middle asks for a heading, the heading error for a steering
    angle. At 5 m/s (a wheelbase of 5 m turns by v x angle / 5 m) the offset dies out with a time
    constant of 1.3 s without overshoot.
    """

    AHEAD_M = 12.0
    """How far ahead a car counts as a neighbour, centre to centre ..."""
    BEHIND_M = 6.0
    """... and how far behind."""
    MIDDLE_LIMIT_M = 0.4
    """The middle is sought no further than this from the lane's: a gap in a neighbouring lane is
    no invitation."""
    HEADING_RAD_PER_M = 0.15
    HEADING_LIMIT_RAD = 0.12
    STEERING_GAIN = 3.0

    def __init__(self, env: CongestionEnv) -> None:
        self.env = env

    def reset(self) -> None:
        """Nothing to forget: the scene says everything."""

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The expert's steering, float32 [1]: from the true state, whatever the picture shows."""
        ego = self.env.ego
        limit = self.HEADING_LIMIT_RAD
        offset_m = float(ego.position[1]) - self.middle_m()
        wanted_rad = min(max(-self.HEADING_RAD_PER_M * offset_m, -limit), limit)
        angle_rad = self.STEERING_GAIN * (wanted_rad - ego.heading)
        share = angle_rad / self.env.config.lambda_rad
        return np.array([min(max(share, -1.0), 1.0)], dtype=np.float32)

    def middle_m(self) -> float:
        """Where to drive: y of the middle of the gap; without a neighbour its lane's inner edge."""
        edge_m = 1.5 * self.env.config.lane_width_m - 0.5 * self.env.ego.WIDTH
        left_m, right_m = -edge_m, edge_m
        x = self.env.ego.position[0]
        for car in self.env.traffic:
            lane_m = car.lane.start[1]
            if lane_m == 0.0 or not -self.BEHIND_M < car.position[0] - x < self.AHEAD_M:
                continue
            if lane_m < 0.0:
                left_m = max(left_m, float(car.position[1]) + 0.5 * car.WIDTH)
            else:
                right_m = min(right_m, float(car.position[1]) - 0.5 * car.WIDTH)
        limit = self.MIDDLE_LIMIT_M
        return min(max(0.5 * (left_m + right_m), -limit), limit)
