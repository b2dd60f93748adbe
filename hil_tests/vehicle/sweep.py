"""Which lag of its actuators a policy bears: every point of the table, in virtual time."""

from __future__ import annotations

import multiprocessing
import statistics
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.episode_report import GOAL
from edge_runtime.errors import UserError
from hil_tests.campaign.axes import Axis
from hil_tests.campaign.budget import budget
from hil_tests.kept import KeptResults
from hil_tests.mock_hunter.parameters import make_parameters
from hil_tests.vehicle.lag_axes import LAG_AXES, Lag
from hil_tests.vehicle.virtual_drive import Driven, VirtualDrive
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import die_with_parent, interrupts_blocked
from trainer.experiments.statistics import Estimate, mean_estimate, success_estimate

MODEL = "hunter-2.0"
FORMAT = 1
"""Raise it where the same point begins to mean another drive: kept points become void."""


class SweepTask(NamedTuple):
    """What every point has in common. ``changes``: parameters of the mock besides the lags."""

    policy: str
    scenario: str
    condition: str
    first_seed: int
    runs: int
    changes: Mapping[str, float]
    public_key: str | None = None


def kept_points(directory: Path, task: SweepTask, policy_id: str) -> KeptResults:
    """Where the points of a task are kept, whatever its policy's file is called."""
    files = ("policy", "public_key")
    deciding = {name: value for name, value in task._asdict().items() if name not in files}
    deciding |= {"format": FORMAT, "policy_id": policy_id}
    return KeptResults(directory, task.scenario, task.condition, deciding)


def run_sweep(
    task: SweepTask,
    lags: Sequence[Lag],
    target: float,
    jobs: int,
    kept: KeptResults,
    on_point: Callable[[dict[str, Any]], None] = lambda row: None,
) -> dict[str, Any]:
    """Drive every point that is not kept, ``jobs`` at a time; the report's part ``sweep``.

    Raises:
        UserError: the policy does not load, or a worker died.
    """
    found = {lag: row for lag in lags if (row := kept.load({"lag": lag.spec})) is not None}
    for row in found.values():
        on_point(row)
    for row in _drive_points(task, [lag for lag in lags if lag not in found], jobs):
        lag = Lag(row["dead_ms"], row["constant_ms"])
        kept.save({"lag": lag.spec}, row)
        found[lag] = row
        on_point(row)
    rows = {lag.spec: found[lag] for lag in lags}
    name = Path(task.policy).stem
    axes = [axis for axis in LAG_AXES if all(axis.spec(value) in rows for value in axis.values)]
    return {
        "policy": task.policy,
        "scenario": task.scenario,
        "condition": task.condition,
        "seed": task.first_seed,
        "runs": task.runs,
        "mock": dict(task.changes),
        "axes": [_axis(axis) for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, target, name) if axes else None,
        "lag_budget": lag_budget(list(rows.values()), target),
    }


def _drive_points(task: SweepTask, lags: Sequence[Lag], jobs: int) -> Iterator[dict[str, Any]]:
    """The rows, each as soon as it is there; one job is this process."""
    if jobs == 1:
        yield from (drive_point(task, lag) for lag in lags)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, initializer=_watch_the_parent)
    try:
        with interrupts_blocked():
            futures: list[Future[dict[str, Any]]] = [
                pool.submit(drive_point, task, lag) for lag in lags
            ]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise UserError("a worker process of the sweep died; use fewer --jobs") from error
    except BaseException:
        # Also on ^C: a point takes long, and is of no use any more.
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def lag_budget(rows: Sequence[Mapping[str, Any]], target: float) -> dict[str, Any]:
    """Up to which sum of dead time and time constant every tested point holds the target.

    ``sum_ms`` is None where the least does not; ``measured_ms`` is the same by the lag that the
    drives showed (points where it could not be told are left out).
    """
    told = [row for row in rows if row["lag_ms"] is not None]
    return {
        "target_success": target,
        "sum_ms": _limit([(row["dead_ms"] + row["constant_ms"], row) for row in rows], target),
        "measured_ms": _limit([(row["lag_ms"], row) for row in told], target),
        "all_hold": all(row["success"]["value"] >= target for row in rows),
    }


def drive_point(task: SweepTask, lag: Lag) -> dict[str, Any]:
    """Drive the episodes of one point; its row."""
    env, driver = _cockpit(task.policy, task.scenario, task.condition, task.public_key)
    drive = VirtualDrive(env, driver, make_parameters(MODEL, {**task.changes, **lag.changes()}))
    driven = [drive.episode(task.first_seed + number) for number in range(task.runs)]
    return make_row(lag, driven, drive.tracking.report(drive.action_names))


def make_row(lag: Lag, driven: Sequence[Driven], tracking: Mapping[str, Any]) -> dict[str, Any]:
    """What a point amounts to: success with Wilson's interval, distance with Student's, of 95 %."""
    outcomes = Counter(episode.outcome for episode in driven)
    return {
        "spec": lag.spec,
        "dead_ms": lag.dead_ms,
        "constant_ms": lag.constant_ms,
        "success": as_dict(success_estimate(outcomes[GOAL], len(driven))),
        "outcomes": dict(outcomes),
        "surviving_distance_m": as_dict(mean_estimate([e.distance_m for e in driven])),
        "episode_time_s": statistics.fmean(e.time_s for e in driven),
        "stops": sum(e.stops for e in driven),
        "lag_ms": tracking["lag_ms"]["speed"],
        "speed_error_mps": tracking["speed_error_mps"],
    }


def as_dict(estimate: Estimate) -> dict[str, float]:
    """As the campaign's rows have it."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def _limit(points: Sequence[tuple[float, Mapping[str, Any]]], target: float) -> float | None:
    failing = [size for size, row in points if row["success"]["value"] < target]
    first = min(failing, default=float("inf"))
    return max((size for size, _ in points if size < first), default=None)


def _axis(axis: Axis) -> dict[str, Any]:
    return {
        "name": axis.name,
        "title": axis.title,
        "unit": axis.unit,
        "values": axis.values,
        "specs": [axis.spec(value) for value in axis.values],
    }


def _watch_the_parent() -> None:
    threading.Thread(target=die_with_parent, daemon=True).start()


@cache
def _cockpit(
    policy: str, scenario: str, condition: str, public_key: str | None
) -> tuple[Any, OnnxDriver]:
    return make_environment(scenario, condition), OnnxDriver(Path(policy), public_key)
