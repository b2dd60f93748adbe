"""From what a policy wants to what a vehicle may be asked. Pure. Contract, section 5."""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Sequence

from edge_runtime.errors import UserError
from edge_runtime.manifest import Action
from edge_runtime.vehicles.interface import ActionLimit
from edge_runtime.wire import CONTROL_PERIOD_S


class LimitRow(NamedTuple):
    """What one action may be: its range, and how fast it may change (inf: at once)."""

    name: str
    low: float
    high: float
    slew_per_s: float


def limit_rows(actions: Sequence[Action], limits: Dict[str, ActionLimit]) -> List[LimitRow]:
    """The manifest's range cut to the vehicle's, for each action in the policy's order.

    An empty table (no vehicle) leaves the manifest's range and any speed of change.
    Raises UserError where a vehicle lacks an action of the policy.
    """
    return [_row(action, limits) for action in actions]


def _row(action: Action, limits: Dict[str, ActionLimit]) -> LimitRow:
    if not limits:
        return LimitRow(action.name, action.low, action.high, math.inf)
    if action.name not in limits:
        raise UserError(
            f"the vehicle has no {action.name!r}, which the policy acts on;"
            f" it has {', '.join(sorted(limits))}"
        )
    limit = limits[action.name]
    low, high = max(action.low, limit.low), min(action.high, limit.high)
    if low > high:
        raise UserError(f"the policy's and the vehicle's range of {action.name!r} do not meet")
    return LimitRow(action.name, low, high, limit.slew_per_s)


def limit_action(
    wanted: Sequence[float], last: Sequence[float], rows: Sequence[LimitRow], elapsed_s: float
) -> List[float]:
    """`wanted` within each row's range, and as near to `last` as the time between them demands.

    More than a control period counts as one: a vehicle need not leap after a pause. A limit that
    does not bite leaves the number as it is, to the last bit.
    """
    elapsed_s = min(max(elapsed_s, 0.0), CONTROL_PERIOD_S)
    limited = []
    for value, previous, row in zip(wanted, last, rows):
        if row.slew_per_s < math.inf:
            most = row.slew_per_s * elapsed_s
            value = min(max(value, previous - most), previous + most)
        limited.append(min(max(value, row.low), row.high))
    return limited


def neutral_action(rows: Sequence[LimitRow]) -> List[float]:
    """Where the limits start before the first command: 0, or the nearest the range allows."""
    return [min(max(0.0, row.low), row.high) for row in rows]


def stop_action(last: Sequence[float], rows: Sequence[LimitRow]) -> List[float]:
    """Full brake at once for a pedal; the last value for a steering."""
    return [row.low if row.name == "pedal" else value for value, row in zip(last, rows)]
