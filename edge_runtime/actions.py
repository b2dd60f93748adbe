"""Actions that may be sent: their limits, the stop, and the plan of a ride-through. Pure."""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence

from edge_runtime.manifest import Action
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_PLAN, MAX_RIDE_S

LATE_PERIODS = 1.2  # So late the next command counts as missing: T, and a fifth of it for jitter


class ActionLimit(NamedTuple):
    """The range of one action, and its fastest change (inf: at once).

    `stop` is its value in a safe stop, None to hold the last one; a vehicle's limits leave it out.
    """

    low: float
    high: float
    slew_per_s: float = math.inf
    stop: Optional[float] = None


Limits = Dict[str, ActionLimit]  # by the action's name


def shared_limits(actions: Sequence[Action], vehicle: Limits) -> Limits:
    """Cut the manifest's range to the vehicle's, for each action in the policy's order.

    An empty table (no vehicle) leaves the manifest's range and any speed of change.
    Raises UserError where a vehicle lacks an action of the policy.
    """
    limits = {}
    for row in actions:
        if vehicle and row.name not in vehicle:
            has, its = ", ".join(sorted(vehicle)), f"{row.name!r}, which the policy acts on"
            raise UserError(f"the vehicle has no {its}; it has {has}")
        theirs = vehicle.get(row.name) or ActionLimit(row.low, row.high)
        low, high = max(row.low, theirs.low), min(row.high, theirs.high)
        if low > high:
            raise UserError(f"the policy's and the vehicle's range of {row.name!r} do not meet")
        slew_per_s = min(row.slew_per_s or math.inf, theirs.slew_per_s)
        stop = None if row.stop is None else min(max(row.stop, low), high)
        limits[row.name] = ActionLimit(low, high, slew_per_s, stop)
    return limits


def limit_action(
    wanted: Sequence[float], last: Sequence[float], limits: Limits, elapsed_s: float
) -> List[float]:
    """Clamp `wanted` to each range, and to the change from `last` that `elapsed_s` allows.

    A limit that does not bite leaves the number as it is, to the last bit.
    """
    limited = []
    for value, previous, limit in zip(wanted, last, limits.values()):
        if limit.slew_per_s < math.inf:
            most = limit.slew_per_s * elapsed_s
            value = min(max(value, previous - most), previous + most)
        limited.append(min(max(value, limit.low), limit.high))
    return limited


def neutral_action(limits: Limits) -> List[float]:
    """Return the action before the first command: 0, or the nearest that the range allows."""
    return [min(max(0.0, limit.low), limit.high) for limit in limits.values()]


def stop_action(last: Sequence[float], limits: Limits) -> List[float]:
    """Return each action's stop, or its last value where it has none, like a steering."""
    pairs = zip(limits.values(), last)
    return [value if limit.stop is None else limit.stop for limit, value in pairs]


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
        """Plan the actions after the command `action`, on towards what the policy `wanted`.

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
        """Return the action that is due, None where none is. Missed ones are left out."""
        action = None
        while now_s >= self.due_s:
            action = self._left.pop(0)
            self._next_s += self._period_s
        return action

    def end(self) -> None:
        """Forget the plan: there is a stop."""
        self._left = []
