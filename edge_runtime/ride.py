"""Ride-through: the further actions of a command, and how this end's own vehicle is played them.

Pure, and loaded only where [ride_through] is set. Why a vehicle may go on: docs/ride_through.md.
"""

from __future__ import annotations

import math
from typing import List, Optional

from edge_runtime.controller import Limits, limit_action
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_PLAN, MAX_RIDE_S

LATE_PERIODS = 1.2  # So late the next command counts as missing: T, and a fifth of it for jitter


class Ride:
    """Makes the plan of each drive command. Where it `plays`, it keeps the newest one.

    A plan asks once more for what the policy wanted, in each further period: fading to neutral, a
    learnt plan and predicted pictures served no better (docs/ride_through.md).
    `max_s` becomes whole periods. Raises UserError where no plan can be as long.
    """

    def __init__(self, max_s: float, period_s: float, limits: Limits, plays: bool) -> None:
        within = 0.0 < max_s <= MAX_RIDE_S  # nor is NaN
        self.periods = int(max_s / period_s + 1e-9) if within else 0
        if not 1 <= self.periods <= MAX_PLAN:
            most_s = min(MAX_RIDE_S, MAX_PLAN * period_s)
            words = f"for this policy's T use {period_s:g} to {most_s:g} s, or 0 for off"
            raise UserError(f"ride_through.max_s {max_s:g} is not valid: {words}")
        self.max_s = self.periods * period_s
        self._period_s, self._limits, self._plays = period_s, limits, plays
        self._left: List[List[float]] = []
        self._next_s = math.inf

    def begin(self, wanted: List[float], action: List[float], now_s: float) -> List[List[float]]:
        """The actions after the command `action`, on towards what the policy `wanted`, from now on.

        Each action is limited like the command's own.
        """
        plan = []
        for _ in range(self.periods):
            action = limit_action(wanted, action, self._limits, self._period_s)
            plan.append(action)
        if self._plays:
            self._left, self._next_s = list(plan), now_s + LATE_PERIODS * self._period_s
        return plan

    @property
    def due_s(self) -> float:
        """When the next action is due for the vehicle; inf where none is left."""
        return self._next_s if self._left else math.inf

    def play(self, now_s: float) -> Optional[List[float]]:
        """The action of this period; None where none is due. What was missed is not made up for."""
        action = None
        while now_s >= self.due_s:
            action = self._left.pop(0)
            self._next_s += self._period_s
        return action

    def end(self) -> None:
        """Nothing is left to play: it stops."""
        self._left = []
