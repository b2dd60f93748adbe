"""The human in the congestion: the scripted expert, and when a person would take over."""

import math

import numpy as np
from numpy.typing import NDArray

from trainer.human.guide import Expert, Reason
from trainer.scenarios.base import Observation, footprint
from trainer.scenarios.congestion import CongestionEnv
from trainer.scenarios.picture import Rectangle, overlap


class CongestionHuman(Expert):
    """Steers to the middle between the neighbours, and judges the policy's action.

    A cascade: the offset from the middle demands a heading, the heading error a steering angle. At
    5 m/s (a wheelbase of 5 m turns by v x angle / 5 m) the offset dies out with a time constant of
    1.3 s, without overshoot.
    """

    AHEAD_M = 12.0  # A car counts as a neighbour up to this far ahead, centre to centre
    BEHIND_M = 6.0  # and up to this far behind
    MIDDLE_LIMIT_M = 0.4
    """Maximum distance from the lane's middle: the car keeps out of gaps in the next lane."""
    HEADING_RAD_PER_M = 0.15
    HEADING_LIMIT_RAD = 0.12
    STEERING_GAIN = 3.0

    HORIZON_S = 0.6
    """Time for which the judged steering is predicted: long enough that the human can always rescue
    the car, and no longer. A human who takes over at the first drift leaves the policy no
    experience; without imitation (HI-TD3) it then learns hardly anything."""
    MARGIN_M = 0.25  # A car that comes nearer than this counts as hit
    HEADING_RAD = 0.2  # Largest heading after one step
    OFFSET_M = 1.1  # Largest distance from the lane's middle at the prediction's end

    def __init__(self, env: CongestionEnv) -> None:
        self.env = env

    def act(self, observation: Observation | None = None) -> NDArray[np.float32]:
        """Return the expert's steering, float32 [1], from the true state, not the picture."""
        ego = self.env.ego
        limit = self.HEADING_LIMIT_RAD
        offset_m = float(ego.position[1]) - self.middle_m()
        wanted_rad = min(max(-self.HEADING_RAD_PER_M * offset_m, -limit), limit)
        angle_rad = self.STEERING_GAIN * (wanted_rad - ego.heading)
        share = angle_rad / self.env.config.lambda_rad
        return np.array([min(max(share, -1.0), 1.0)], dtype=np.float32)

    def middle_m(self) -> float:
        """Return y of the gap's middle; a missing neighbour counts as its lane's inner edge."""
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

    def wants_control(self, action: NDArray) -> Reason | None:
        """Return why a person would take over from ``action`` now, or None; call it once a step."""
        env = self.env
        steps = round(self.HORIZON_S / env.config.control_period_s)
        angle_rad = float(action[0]) * env.config.lambda_rad
        motion = self._motion(angle_rad, steps)
        if abs(motion[0].heading) > self.HEADING_RAD:
            return "heading"
        for step, shape in enumerate(motion, start=1):
            if self._hits(shape, step * env.config.control_period_s):
                return "collision"
        return "offset" if abs(motion[-1].y) > self.OFFSET_M else None

    def _motion(self, angle_rad: float, steps: int) -> list[Rectangle]:
        """Predict the ego car's footprints under a held steering angle, at its present speed."""
        env = self.env
        shape, dt_s = footprint(env.ego), env.config.control_period_s
        slip_rad = math.atan(0.5 * math.tan(angle_rad))
        move_m = env.ego.speed * dt_s
        shapes = []
        for _ in range(steps):
            course_rad = shape.heading + slip_rad
            shape = shape._replace(
                x=shape.x + move_m * math.cos(course_rad),
                y=shape.y + move_m * math.sin(course_rad),
                heading=shape.heading + move_m * math.sin(slip_rad) / (0.5 * shape.length),
            )
            shapes.append(shape)
        return shapes

    def _hits(self, ego: Rectangle, ahead_s: float) -> bool:
        """Whether a car of a neighbouring lane, at constant speed, will be within the margin.

        The pedals, not the steering, keep the distance to cars in the ego car's own lane.
        """
        wider = ego._replace(width=ego.width + 2.0 * self.MARGIN_M)
        for car in self.env.traffic:
            if car.lane.start[1] == 0.0:
                continue
            shape = footprint(car)
            if overlap(wider, shape._replace(x=shape.x + car.speed * ahead_s)):
                return True
        return False
