"""The scripted expert of the left turn: what an attentive driver would do, from the true state."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trainer.human.crossing import Crossing, PedalPlan
from trainer.scenarios.left_turn import LeftTurnEnv, Observation


class LeftTurnExpert:
    """Waits at the stop line, picks a gap, and then commits.

    A driver who changes their mind with the nose in the lane is hit; one who needs a wide gap to
    start and a narrow one to go on is not, and is easier to imitate.
    """

    HORIZON_S = 6.0
    START_MARGIN_M = 2.5
    """Room to every car while turning. With 1.5 m the expert is as safe, but of its imitators, who
    start some tenths of a second early or late, every tenth touches the car that just passed."""
    KEEP_MARGIN_M = 0.3
    POINT_OF_NO_RETURN_M = 8.0
    """Path length at which the nose comes within 0.5 m of the cars of the near lane."""
    APPROACH_MPS2 = 1.5
    """Comfortable deceleration towards the stop line; full brake is kept for surprises."""
    CRUISE_MPS = 5.2
    SIDE_CLEARANCE_M = 0.3
    """Room to the sides of a passing car."""
    GO = PedalPlan(then_mps=CRUISE_MPS)

    def __init__(self, env: LeftTurnEnv) -> None:
        self.env = env
        self.crossing = Crossing(env, self.SIDE_CLEARANCE_M)
        self.going = False

    def reset(self) -> None:
        """Forget the last episode."""
        self.going = False

    def would_go(self) -> bool:
        """Whether a driver standing here would start now."""
        return self.crossing.clear(self.HORIZON_S, self.START_MARGIN_M, self.GO)

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The expert's pedal, float32 [1]: from the true state, whatever the picture shows."""
        if self._beyond_return():
            self.going = True
        else:
            margin_m = self.KEEP_MARGIN_M if self.going else self.START_MARGIN_M
            self.going = self.crossing.clear(self.HORIZON_S, margin_m, self.GO)
        return np.array([self._go() if self.going else self._wait()], dtype=np.float32)

    def _beyond_return(self) -> bool:
        """Whether even full brake would leave the nose in the lane."""
        env = self.env
        stopping_m = env.ego.speed**2 / (2.0 * env.config.brake_mps2)
        return env.distance_m + stopping_m > self.POINT_OF_NO_RETURN_M

    def _go(self) -> float:
        return min(max(2.0 * (self.CRUISE_MPS - self.env.ego.speed), -1.0), 1.0)

    def _wait(self) -> float:
        """Slow down on a speed that falls with the distance to the line, and stand there."""
        to_line_m = self.env.config.stop_line_m - self.env.distance_m
        wanted_mps = math.sqrt(2.0 * self.APPROACH_MPS2 * max(to_line_m - 0.5, 0.0))
        if wanted_mps == 0.0:
            return -1.0
        return min(max(wanted_mps - self.env.ego.speed, -1.0), 0.3)
