"""Policy in the loop against vehicle in the loop: the same seeds, standing starts, real time."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from typing import Any

from bridge.report import GOAL
from hil_tests.campaign.rows import make_row
from hil_tests.vehicle.rigs import LOOPS, POLICY, VEHICLE, Drive, run_rig
from hil_tests.vehicle.sweep import as_dict
from trainer.experiments.statistics import mean_estimate

PART_EPISODES = 5
"""One rig's turn. Short, so that all rigs end at about the same time."""


def run_comparison(
    drive: Drive, target: float, rigs: int, on_part: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Drive both loops, ``rigs`` at a time; the report's part ``comparison``.

    ``drive`` says what, with all the episodes; its own loop is of no account.

    Raises:
        UserError: a command failed.
    """
    reports = _run_all([part for loop in LOOPS for part in parts(drive, loop)], rigs, on_part)
    rows = {loop: loop_row(loop, [r for r in reports if r["loop"] == loop]) for loop in LOOPS}
    return {
        "policy": str(drive.policy),
        "scenario": drive.scenario,
        "condition": drive.condition,
        "seed": drive.first_seed,
        "runs": drive.episodes,
        "mock": dict(drive.changes),
        "rows": rows,
        "cost": cost(rows[POLICY]["per_episode"], rows[VEHICLE]["per_episode"]),
        "target_success": target,
        "holds": rows[VEHICLE]["success"]["value"] >= target,
    }


def parts(drive: Drive, loop: str) -> list[Drive]:
    """The drive in turns of PART_EPISODES."""
    end = drive.first_seed + drive.episodes
    return [
        drive._replace(loop=loop, first_seed=seed, episodes=min(PART_EPISODES, end - seed))
        for seed in range(drive.first_seed, end, PART_EPISODES)
    ]


def loop_row(loop: str, reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Join the reports of one loop, in any order."""
    ordered = sorted(reports, key=lambda report: report["seed"])
    chunks = [
        {**report, "episodes": [_episode(row) for row in report["per_episode"]]}
        for report in ordered
    ]
    reasons = Counter(e["reason"] for report in ordered for e in report["safe_stop_events"])
    vehicles = [report["vehicle"] for report in ordered if report["vehicle"] is not None]
    return {
        **make_row(loop, chunks),
        "safe_stop_reasons": dict(reasons),
        "tick_overruns": sum(report["tick_overruns"] for report in ordered),
        "vehicle": join_vehicles(vehicles) if vehicles else None,
    }


def join_vehicles(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One report of a vehicle for several: errors pooled, lags and ages the median of the parts.

    The largest stands for ``max`` and ``p99``.
    """
    actions = list(parts[0]["action_error"])
    faults: Counter[str] = Counter()
    for part in parts:
        faults.update(part["faults"])
    return {
        "name": parts[0]["name"],
        "scale": parts[0]["scale"],
        "samples": sum(part["samples"] for part in parts),
        "speed_error_mps": _pool(parts, lambda part: part["speed_error_mps"]),
        "action_error": {
            name: _pool(parts, lambda part, name=name: part["action_error"][name])  # type: ignore[misc]
            for name in actions
        },
        "lag_ms": {
            name: _median([part["lag_ms"][name] for part in parts]) for name in parts[0]["lag_ms"]
        },
        "feedback_age_ms": {
            "p50": _median([part["feedback_age_ms"]["p50"] for part in parts]),
            "p99": _most([part["feedback_age_ms"]["p99"] for part in parts]),
        },
        "faults": dict(faults),
        "moving_starts": sum(part["moving_starts"] for part in parts),
    }


def cost(
    policy: Sequence[Mapping[str, Any]], vehicle: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """What the actuators cost in time, by seed, where both loops reach the goal; 95 % interval."""
    times = {row["seed"]: row["time_s"] for row in policy if row["outcome"] == GOAL}
    longer = [
        row["time_s"] - times[row["seed"]]
        for row in vehicle
        if row["outcome"] == GOAL and row["seed"] in times
    ]
    return {"seeds": len(longer), "longer_s": as_dict(mean_estimate(longer))}


def _run_all(
    drives: Sequence[Drive], rigs: int, on_part: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    def told(done: Future[dict[str, Any]]) -> None:
        if not done.cancelled() and done.exception() is None:
            on_part(done.result())

    with ThreadPoolExecutor(rigs) as pool:
        futures = [pool.submit(run_rig, drive) for drive in drives]
        for future in futures:
            future.add_done_callback(told)
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:  # Also on ^C: what has not begun is not begun any more.
            pool.shutdown(wait=False, cancel_futures=True)
        return [future.result() for future in futures if not future.cancelled()]


def _episode(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("seed", "outcome", "distance_m", "time_s", "steps")}


def _pool(
    parts: Sequence[Mapping[str, Any]], of: Callable[[Mapping[str, Any]], Mapping[str, Any]]
) -> dict[str, float | None]:
    told = [(part["samples"], of(part)) for part in parts if of(part)["rmse"] is not None]
    if not told:
        return {"rmse": None, "max": None}
    squares = sum(samples * error["rmse"] ** 2 for samples, error in told)
    return {
        "rmse": (squares / sum(samples for samples, _ in told)) ** 0.5,
        "max": max(error["max"] for _, error in told),
    }


def _median(values: Sequence[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return statistics.median(told) if told else None


def _most(values: Sequence[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)
