"""The latency budget of a policy: one sentence, made from the rows. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hil_tests.campaign.axes import Axis

NO_NETWORK = "none"


def limit_of(axis: Axis, rows: Mapping[str, Mapping[str, Any]], target: float) -> float | None:
    """The largest tested value up to which success is at the target at every tested value.

    Success is the share of the row's episodes (the point estimate), and nothing is interpolated.
    None where it is below the target even at 0.
    """
    limit: float | None = None
    for value in axis.values:
        if rows[axis.spec(value)]["success"]["value"] < target:
            return limit
        limit = value
    return limit


def budget(
    axes: Sequence[Axis], rows: Mapping[str, Mapping[str, Any]], target: float, name: str
) -> dict[str, Any]:
    """Each axis's limit, whether it is only the end of what was tested, and the sentence."""
    limits = {axis.name: limit_of(axis, rows, target) for axis in axes}
    open_ended = {axis.name: limits[axis.name] == axis.values[-1] for axis in axes}
    return {
        "target_success": target,
        "limits": limits,
        "up_to_the_largest_tested": open_ended,
        "sentence": _sentence(axes, limits, open_ended, target, name),
    }


def _sentence(
    axes: Sequence[Axis],
    limits: Mapping[str, float | None],
    open_ended: Mapping[str, bool],
    target: float,
    name: str,
) -> str:
    parts, missed = [], []
    for axis in axes:
        limit = limits[axis.name]
        if limit is None and axis.base == NO_NETWORK:
            return f"{name} is below {target:.0%} success even on a perfect network."
        if limit is None:
            missed.append(f"on {axis.base} alone it is below that, so no {axis.name} has a budget")
            continue
        shown = axis.limit.format(f"{limit:g} {axis.unit}" if limit else "none")
        parts.append(f"{shown} (the most that was tested)" if open_ended[axis.name] else shown)
    if not parts:
        return f"{name}: " + "; ".join(missed) + "."
    listed = ", ".join(parts[:-1]) + (" and " if parts[:-1] else "") + parts[-1]
    held = f"{name} holds at least {target:.0%} success up to {listed}, one at a time"
    return "; ".join([held, *missed]) + "."
