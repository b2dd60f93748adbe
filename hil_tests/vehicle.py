"""``python -m hil_tests vehicle``: what the actuators of a vehicle cost, and what they may cost.

`compare` drives the same seeds in real time, once with the policy in the loop and once with a mock
Hunter; `sweep` drives every lag of a table in virtual time.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any

from bridge.report import GOAL
from edge_runtime.cli import ArgumentParser, examples, positive, sigterm_as_interrupt
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError
from hil_tests.faults.rig import free_bus
from hil_tests.mock_hunter.body import make_parameters, read_changes
from hil_tests.processes import BackgroundCommand, in_parallel, operator, trusting
from hil_tests.report import (
    check_report,
    comparison_verdict,
    lag_sentence,
    render_comparison,
    render_sweep,
    write_lag_figures,
    write_report,
)
from hil_tests.sweep import (
    LAG_AXES,
    LAGS,
    LOOPS,
    POLICY,
    VEHICLE,
    KeptResults,
    Lag,
    Task,
    add_sweep_arguments,
    budget,
    interval,
    make_row,
    simulate,
    summary,
    task_of,
    this_command,
    turns,
    worth_keeping,
)
from hil_tests.virtual_drive import Driven, VirtualDrive
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import cores
from trainer.experiments.statistics import mean_estimate
from trainer.util import ProgressBar

PARTS = ("compare", "sweep")
MODEL = "hunter-2.0"
VEHICLE_ID = "rig01"
PART_EPISODES = 5
"""One rig's turn. Short, so that all rigs end at about the same time."""
LONGEST_EPISODE_S = 60.0
"""With the wait for a stand before it; the scenarios time out after 30 s."""
FORMAT = 1
"""Raise it where the same point begins to mean another drive: kept points become void."""
EXAMPLE = examples(
    "python -m hil_tests vehicle --out runs/vehicle.json",
    "python -m hil_tests vehicle --only sweep --lags 50+100,200+300 --runs 20 --out runs/lags.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_sweep_arguments(parser, PARTS, 50, "episodes of each loop and of each lag", 0.95)
    rigs = "simulators in real time side by side, each with a vehicle of its own"
    parser.add_argument("--rigs", type=positive, default=4, metavar="N", help=rigs)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of the mock Hunter, as in python -m hil_tests mock_hunter",
    )
    parser.add_argument(
        "--lags",
        metavar="DEAD+CONSTANT,...",
        help="only these points of the sweep, in ms, as in 50+100,200+300",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where the vehicle in the loop is below the target."""
    out = Path(arguments.out)
    check_report(out)
    task = task_of(arguments)._replace(changes=read_changes(arguments.set))
    make_parameters(MODEL, task.changes)  # refuses what the mock does not know
    lags = _lags(arguments.lags)
    report: dict[str, Any] = {"command": this_command(), "policy_id": task.policy_id}
    title = f"# Vehicle in the loop: {task.policy.name}, {arguments.scenario}"
    text = [title, "", f"`{this_command()}`"]
    with sigterm_as_interrupt():  # Whoever ends it ends its processes.
        if arguments.only != "sweep":
            report["comparison"] = found = run_comparison(task, arguments.target, arguments.rigs)
            text += ["", "## In real time", "", render_comparison(found)]
        if arguments.only != "compare":
            keep, jobs = out.with_name(f"{out.stem}_rows"), arguments.jobs or cores()
            report["sweep"] = found = run_sweep(task, lags, arguments.target, jobs, keep)
            found["figures"] = write_lag_figures(out, found)
            text += ["", "## Lag, in virtual time", "", render_sweep(found, found["figures"])]
    write_report(out, report, text)
    return _conclude(out, report)


def _conclude(out: Path, report: dict[str, Any]) -> int:
    holds = True
    if "comparison" in report:
        print(comparison_verdict(report["comparison"]))
        holds = report["comparison"]["holds"]
    if "sweep" in report:
        print(lag_sentence(report["sweep"]))
    print(f"{out} and {out.with_suffix('.md')}")
    return 0 if holds else 1


def _lags(text: str | None) -> list[Lag]:
    if text is None:
        return LAGS
    lags = []
    for point in text.split(","):
        dead, _, constant = point.partition("+")
        if not (dead.isdecimal() and constant.isdecimal() and int(constant) > 0):
            raise UserError(f"--lags {point!r} is no lag: write DEAD+CONSTANT in ms, as in 50+100")
        lags.append(Lag(int(dead), int(constant)))
    return list(dict.fromkeys(lags))


def run_comparison(task: Task, target: float, rigs: int) -> dict[str, Any]:
    """Drive both loops, ``rigs`` at a time; the report's part ``comparison``.

    Raises:
        UserError: a command failed.
    """
    reports: dict[str, list[dict[str, Any]]] = {loop: [] for loop in LOOPS}
    parts = [
        (loop, task._replace(seed=seed, runs=runs))
        for loop in LOOPS
        for seed, runs in turns(task.seed, task.runs, PART_EPISODES)
    ]
    with ProgressBar("drives", len(parts)) as bar:

        def on_done(part: tuple[str, Task], report: dict[str, Any]) -> None:
            reports[part[0]].append(report)
            bar.advance({"success": f"{report['success_rate']:.2f}", "loop": report["loop"]})

        in_parallel(lambda part: run_rig(part[1], part[0]), parts, rigs, on_done)
    rows = {loop: loop_row(loop, some) for loop, some in reports.items()}
    return {
        **task.facts(),
        "mock": task.changes,
        "rows": rows,
        "cost": cost(rows[POLICY]["per_episode"], rows[VEHICLE]["per_episode"]),
        "target_success": target,
        "holds": rows[VEHICLE]["success"]["value"] >= target,
    }


def run_rig(task: Task, loop: str) -> dict[str, Any]:
    """Edge runtime, simulator and (with a vehicle in the loop) mock Hunter and operator.

    All are processes, set up for this drive and cleared away after it; the simulator's report,
    with its command.

    Raises:
        UserError: a command failed; it has said why.
    """
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory(prefix="phil-rig-") as folder, ExitStack() as stack:
        options = _start_vehicle(task, Path(folder), stack) if loop == VEHICLE else ()
        stack.enter_context(
            BackgroundCommand(
                "edge_runtime", "run", *trusting(task.policy, task.public_key),
                "--connect", endpoint, "--vehicle-id", VEHICLE_ID, *options,
                ready="ready", quiet=True,
            )
        )  # fmt: skip
        if loop == VEHICLE:
            stack.enter_context(operator(endpoint, VEHICLE_ID))
        limit_s = LONGEST_EPISODE_S * (1 + task.runs)
        report: dict[str, Any] = simulate(
            endpoint, VEHICLE_ID, Path(folder) / "report.json", limit_s,
            "--env", task.scenario, "--condition", task.condition,
            "--clock", "realtime", "--loop", loop, "--standing",
            "--episodes", str(task.runs), "--seed", str(task.seed),
        )  # fmt: skip
        return report


def _start_vehicle(task: Task, directory: Path, stack: ExitStack) -> tuple[str, ...]:
    """Start a mock Hunter on a bus of its own; the edge runtime's options to drive it."""
    bus = free_bus()
    settings = [f"--set={name}={value}" for name, value in task.changes.items()]
    chassis = ("hil_tests", "mock_hunter", "--bus", bus, *settings)
    stack.enter_context(BackgroundCommand(*chassis, ready="ready", quiet=True))
    config = directory / "edge.toml"
    config.write_text(f'bus = "{bus}"\n')
    return ("--vehicle", "hunter", "--config", str(config))


def loop_row(loop: str, reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Join the reports of one loop, in any order."""
    ordered = sorted(reports, key=lambda report: report["seed"])
    reasons = Counter(e["reason"] for report in ordered for e in report["safe_stop_events"])
    vehicles = [report["vehicle"] for report in ordered if report["vehicle"] is not None]
    return {
        **make_row(loop, [worth_keeping(report) for report in ordered]),
        "safe_stop_reasons": dict(reasons),
        "tick_overruns": sum(report["tick_overruns"] for report in ordered),
        "vehicle": join_vehicles(vehicles) if vehicles else None,
    }


def join_vehicles(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One report of a vehicle for several: errors pooled, lags and ages the median of the parts.

    The largest stands for ``max`` and ``p99``.
    """
    ages = [part["feedback_age_ms"] for part in parts]
    return {
        "name": parts[0]["name"],
        "scale": parts[0]["scale"],
        "samples": sum(part["samples"] for part in parts),
        "speed_error_mps": _pool([(part["samples"], part["speed_error_mps"]) for part in parts]),
        "action_error": {
            name: _pool([(part["samples"], part["action_error"][name]) for part in parts])
            for name in parts[0]["action_error"]
        },
        "lag_ms": {
            name: _of_told(statistics.median, [part["lag_ms"][name] for part in parts])
            for name in parts[0]["lag_ms"]
        },
        "feedback_age_ms": {
            "p50": _of_told(statistics.median, [age["p50"] for age in ages]),
            "p99": _of_told(max, [age["p99"] for age in ages]),
        },
        "faults": dict(sum((Counter(part["faults"]) for part in parts), Counter())),
        "moving_starts": sum(part["moving_starts"] for part in parts),
    }


def _pool(errors: Sequence[tuple[int, Mapping[str, float]]]) -> dict[str, float | None]:
    told = [(samples, error) for samples, error in errors if error["rmse"] is not None]
    if not told:
        return {"rmse": None, "max": None}
    squares = sum(samples * error["rmse"] ** 2 for samples, error in told)
    rmse = (squares / sum(samples for samples, _ in told)) ** 0.5
    return {"rmse": rmse, "max": max(error["max"] for _, error in told)}


def _of_told(join: Callable[[list[float]], float], values: Sequence[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return join(told) if told else None


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
    return {"seeds": len(longer), "longer_s": interval(mean_estimate(longer))}


def run_sweep(
    task: Task, lags: Sequence[Lag], target: float, jobs: int, keep: Path
) -> dict[str, Any]:
    """Drive every point that is not kept, ``jobs`` at a time; the report's part ``sweep``.

    Raises:
        UserError: the policy does not load, or a worker died.
    """
    deciding = {
        "format": FORMAT,
        "policy_id": task.policy_id,  # whatever its file is called
        "first_seed": task.seed,
        "runs": task.runs,
        "changes": task.changes,
    }
    found = KeptResults(keep, task, deciding).complete(
        "lags",
        lags,
        lambda lag: {"lag": lag.spec},
        lambda missing, on_done: in_parallel(
            partial(drive_point, task), missing, jobs, on_done, processes=True
        ),
        lambda lag, row: {"success": f"{row['success']['value']:.2f}", "at": lag.spec},
    )
    rows = {lag.spec: found[lag] for lag in lags}
    axes = [axis for axis in LAG_AXES if set(axis.specs) <= set(rows)]
    return {
        **task.facts(),
        "mock": task.changes,
        "axes": [axis.as_dict() for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, target, task.policy.stem) if axes else None,
        "lag_budget": lag_budget(list(rows.values()), target),
    }


def drive_point(task: Task, lag: Lag) -> dict[str, Any]:
    """Drive the episodes of one point; its row."""
    env, driver = _cockpit(task.policy, task.scenario, task.condition, task.public_key)
    parameters = make_parameters(MODEL, {**task.changes, **lag.changes()})
    virtual = VirtualDrive(env, driver, parameters)
    driven = [virtual.episode(task.seed + number) for number in range(task.runs)]
    return lag_row(lag, driven, virtual.tracking.report(virtual.action_names))


@cache
def _cockpit(
    policy: Path, scenario: str, condition: str, public_key: str | None
) -> tuple[Any, OnnxDriver]:
    return make_environment(scenario, condition), OnnxDriver(policy, public_key)


def lag_row(lag: Lag, driven: Sequence[Driven], tracking: Mapping[str, Any]) -> dict[str, Any]:
    """What a point amounts to."""
    return {
        "spec": lag.spec,
        "dead_ms": lag.dead_ms,
        "constant_ms": lag.constant_ms,
        **summary([episode._asdict() for episode in driven]),
        "stops": sum(episode.stops for episode in driven),
        "lag_ms": tracking["lag_ms"]["speed"],
        "speed_error_mps": tracking["speed_error_mps"],
    }


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


def _limit(points: Sequence[tuple[float, Mapping[str, Any]]], target: float) -> float | None:
    failing = [size for size, row in points if row["success"]["value"] < target]
    first = min(failing, default=float("inf"))
    return max((size for size, _ in points if size < first), default=None)
