"""When a person would take over: the activation conditions of section V, for the left turn."""

from __future__ import annotations

from numpy.typing import NDArray

from trainer.human.crossing import PedalPlan
from trainer.human.expert import LeftTurnExpert
from trainer.human.guide import Reason


class LeftTurnTrigger:
    """Judges the policy's action before it is carried out.

    Args:
        expert: knows the environment and what a driver would do in it.
    """

    HOLD_S = 0.5
    """How long the judged pedal is taken to be held; after that the speed is kept."""
    HORIZON_S = 2.5
    MARGIN_M = 0.3
    STANDING_MPS = 0.3
    STANDING_STEPS = 15

    def __init__(self, expert: LeftTurnExpert) -> None:
        self.expert = expert
        self.standing_steps = 0

    def reset(self) -> None:
        """Forget the last episode."""
        self.standing_steps = 0

    def judge(self, action: NDArray) -> Reason | None:
        """Why a person would take over from ``action`` now, or None. Once a control period."""
        standing = self.expert.env.ego.speed < self.STANDING_MPS
        self.standing_steps = self.standing_steps + 1 if standing else 0
        plan = PedalPlan(pedal=float(action[0]), hold_s=self.HOLD_S)
        if not self.expert.crossing.clear(self.HORIZON_S, self.MARGIN_M, plan):
            return "collision"
        if self.standing_steps > self.STANDING_STEPS and self.expert.would_go():
            return "stuck"
        return None
