"""When a person would take over: the activation conditions of section V, for the left turn."""

from __future__ import annotations

from numpy.typing import NDArray

from trainer.human.crossing import PedalPlan
from trainer.human.expert import LeftTurnExpert
from trainer.human.guide import Reason


class LeftTurnTrigger:
    """Judges the policy's action before it is carried out.

    A person lets an action pass that leaves a way out and does not stop in the lane. A judge that
    asked only where the present pedal leads would object to each brisk approach to the stop line,
    the expert's own, too; but theorem 1 holds only where no optimal policy goes where the human
    takes over.

    Args:
        expert: knows the environment and what a driver would do in it.
    """

    HOLD_S = 0.5
    """How long the judged pedal is taken to be held: a person's reaction time."""
    RESCUE_BRAKE = 0.85
    """Share of the full brake with which the car could then still be stopped in time; the rest is
    room for a human who is a network."""
    STOP_BY_M = LeftTurnExpert.POINT_OF_NO_RETURN_M - 0.5
    """Path length by which it must then stand; past the point of no return a car can only be driven
    on, and who creeps up to it has not waited."""
    RESCUE_MARGIN_M = 1.0
    """Room along the lane with which it could then still drive on, at full throttle."""
    HESITATION_S = 1.0
    """How long the judged pedal is taken to be held by who would then be in the lane."""
    CRAWL_MPS = 1.5
    """Who would then be slower than this within the lane is stopping there: nobody's plan, since
    the traffic does not yield."""
    STANDING_MPS = 0.3
    STANDING_STEPS = 15
    """Steps that a car stands before anybody thinks of it as stuck."""
    OPEN_STEPS = 5
    """Steps that the way must then have been free: a person's reaction time once more."""
    START_PEDAL = 0.2
    """Least throttle that counts as driving on by oneself."""

    def __init__(self, expert: LeftTurnExpert) -> None:
        self.expert = expert
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self.standing_steps = self.open_steps = 0

    def judge(self, action: NDArray) -> Reason | None:
        """Why a person would take over from ``action`` now, or None. Once a control period."""
        pedal = float(action[0])
        standing = self.expert.env.ego.speed < self.STANDING_MPS
        self.standing_steps = self.standing_steps + 1 if standing else 0
        waiting = self.standing_steps > self.STANDING_STEPS
        self.open_steps = self.open_steps + 1 if waiting and self.expert.would_go() else 0
        if not self._leaves_a_way_out(pedal):
            return "collision"
        if self._stops_in_the_lane(pedal):
            return "lane"
        return "stuck" if self.open_steps > self.OPEN_STEPS and pedal < self.START_PEDAL else None

    def may_return(self) -> bool:
        """Whether the wheel can be given back: nobody does while driving through the lane.

        Who stands there gives up: a human who is a network might stand there for ever.
        """
        standing = self.expert.env.ego.speed < self.STANDING_MPS
        return standing or not self.expert.crossing.in_lane(self.expert.env.distance_m)

    def _stops_in_the_lane(self, pedal: float) -> bool:
        """Whether after this pedal the car hardly moves, with its nose in the lane."""
        if pedal >= self.START_PEDAL:
            return False
        held = PedalPlan(pedal, self.HESITATION_S)
        at_m, speed_mps = self.expert.crossing.state_after(self.HESITATION_S, held)
        return speed_mps < self.CRAWL_MPS and self.expert.crossing.in_lane(at_m)

    def _leaves_a_way_out(self, pedal: float) -> bool:
        """Whether after this pedal the car can still be stopped, or driven on, unharmed."""
        expert, crossing = self.expert, self.expert.crossing
        stop = PedalPlan(pedal, self.HOLD_S, then_brake=self.RESCUE_BRAKE)
        if crossing.state_after(expert.HORIZON_S, stop)[0] <= self.STOP_BY_M or self._stays(pedal):
            return True
        go = PedalPlan(pedal, self.HOLD_S, then_mps=expert.CRUISE_MPS)
        return crossing.clear(expert.HORIZON_S, self.RESCUE_MARGIN_M, go)

    def _stays(self, pedal: float) -> bool:
        """Whether the car stands outside of the lane, and goes on standing."""
        ego_at_m, last_m = self.expert.env.distance_m, self.expert.POINT_OF_NO_RETURN_M
        return pedal <= 0.0 and self.expert.env.ego.speed == 0.0 and ego_at_m <= last_m
