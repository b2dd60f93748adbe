"""``python -m hil_tests campaign`` and ``vehicle``: reports of many drives.

The first does every fault, and drives every network of the axes through real edge runtimes. The
second says what the actuators of a vehicle cost and what they may cost: `compare` drives the same
seeds in real time, once with the policy in the loop and once with a mock Hunter; `sweep` drives
every lag of a table in virtual time.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bridge.environments import CONDITIONS, NOMINAL
from bridge.progress import ProgressBar
from edge_runtime.cli import Command, add_public_key, examples, not_negative, positive, share
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests import report, sweep
from hil_tests.faults.run import choose_rows, run_faults
from hil_tests.mock_hunter.hunter import make_parameters, read_changes
from trainer.options import add_scenario
from trainer.util import cores

PART_EPISODES, LOOP_EPISODES = 50, 5
"""Of a network, in virtual time; of a loop, in real time: short, so that all rigs end at about the
same time."""
LONGEST_EPISODE_S = 60.0  # With the wait for a stand before it; the scenarios time out after 30 s
SHOWN_WRONG = 5


def _add_shared(
    parser: argparse.ArgumentParser, parts: Sequence[str], runs: int, of_what: str, target: float
) -> None:
    out = "the report; R.md, pictures and R_rows/ (what is done already) go beside it"
    parser.add_argument("--out", required=True, metavar="R.json", help=out)
    default = "policy file (default: results/policies/SCENARIO.onnx)"
    parser.add_argument("--policy", metavar="P.onnx", help=default)
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument("--condition", choices=CONDITIONS, default=NOMINAL, help="scene")
    parser.add_argument("--only", choices=parts, help="one part (default: both)")
    for name, kind, value, text in (
        ("--runs", _several, runs, of_what),
        ("--seed", not_negative, 0, "of the first episode"),
        ("--target", share, target, "success that is asked for"),
        ("--jobs", not_negative, 0, "drives or faults side by side; 0: one a core"),
    ):
        parser.add_argument(name, type=kind, default=value, help=text)


def _several(text: str) -> int:
    count = positive(text)
    if count < 2:
        raise argparse.ArgumentTypeError(f"{text} is too few: 2 or more have an interval")
    return count


def _add_campaign_arguments(parser: argparse.ArgumentParser) -> None:
    runs_help = "episodes of each row, the same seeds"
    _add_shared(parser, ("latency", "faults"), 100, runs_help, 0.98)
    axes = ", ".join(axis.name for axis in sweep.NETWORK_AXES)
    rows = f"only these latency axes ({axes}) and faults, by name or pattern (hunter_*)"
    parser.add_argument("--rows", metavar="NAME,...", help=rows)
    parser.add_argument("--tries", type=positive, default=10, help="of each fault")


def _run_campaign(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where a fault was not met as it should be."""
    out = Path(arguments.out)
    report.check_report(out)
    axes, faults = _choose(arguments)
    jobs = arguments.jobs or cores()
    result: dict[str, Any] = {"command": _this_command()}
    name = Path(arguments.policy or f"{arguments.scenario}.onnx").name
    text = [f"# Campaign: {name}, {arguments.scenario}", "", f"`{_this_command()}`", ""]
    if axes:
        latency = run_latency(_task(arguments), axes, arguments.target, jobs, out)
        result["latency"] = latency
        text += ["## Latency", "", report.render_latency(latency)]
        print(latency["budget"]["sentence"])
    if faults is not None:
        with ProgressBar("faults", arguments.tries * len(choose_rows(faults or None))) as bar:
            found = run_faults(
                arguments.tries, faults or None, arguments.policy and Path(arguments.policy),
                lambda row: bar.advance({"row": row}), jobs, arguments.public_key,
            )  # fmt: skip
        result["faults"] = found
        text += ["## Faults", "", report.render_faults(found)]
        for row in found["rows"]:
            for kind in ("wrong", "unsafe", "crashes"):
                for what in row[kind][:SHOWN_WRONG]:
                    print(f"{row['name']}: {kind}: {what}")
        print("Every fault was met." if found["passed"] else "Not every fault was met.")
    report.write_report(out, result, text)
    return 0 if faults is None or result["faults"]["passed"] else 1


def _choose(arguments: argparse.Namespace) -> tuple[list[sweep.Axis], list[str] | None]:
    """The latency axes, and the faults by name ([]: all of them; None: no faults)."""
    known = {axis.name: axis for axis in sweep.NETWORK_AXES}
    named = arguments.rows.split(",") if arguments.rows else []
    axes = [known[name] for name in named if name in known] if named else list(known.values())
    faults = [name for name in named if name not in known]
    if faults and arguments.only == "latency":
        raise UserError(f"no latency axis {faults[0]!r}; choose from {', '.join(known)}")
    if arguments.only == "faults":
        if named and not faults:
            raise UserError(f"{arguments.rows} names latency axes, no fault")
        axes = []
    choose_rows(faults)  # now, not after the hours of the latency rows
    without_faults = arguments.only == "latency" or (named and not faults)
    return axes, None if without_faults else faults


def _task(arguments: argparse.Namespace, changes: dict[str, float] | None = None) -> sweep.Task:
    """UserError where the policy does not load; its signature is the edge runtime's to check."""
    policy = Path(arguments.policy or f"results/policies/{arguments.scenario}.onnx")
    loaded = load_policy(str(policy), arguments.public_key, allow_unsigned=True)
    return sweep.Task(
        policy, loaded.policy_id, arguments.scenario, arguments.condition, arguments.seed,
        arguments.runs, arguments.public_key, changes or {},
    )  # fmt: skip


def _this_command() -> str:
    return "python -m hil_tests " + shlex.join(sys.argv[1:])


def _rows_beside(out: Path) -> Path:
    return out.with_name(f"{out.stem}_rows")


def run_latency(
    task: sweep.Task, axes: Sequence[sweep.Axis], target: float, jobs: int, out: Path
) -> dict[str, Any]:
    """Drive every network of the axes; the report's part ``latency``."""
    specs = list(dict.fromkeys(spec for axis in axes for spec in axis.specs))
    drive, keep = sweep.drive_network, _rows_beside(out)
    found = sweep.drive_all(task, specs, PART_EPISODES, drive, jobs, keep)
    rows = {spec: sweep.make_row(spec, parts) for spec, parts in found.items()}
    driven_s, wall_s = (sum(row[name] for row in rows.values()) for name in ("driven_s", "wall_s"))
    told = ("name", "title", "unit", "values", "specs")
    latency = {
        **task.facts(),
        "clock": "lockstep",
        "axes": [{name: getattr(axis, name) for name in told} for axis in axes],
        "rows": rows,
        "budget": sweep.budget(axes, rows, target, task.policy.stem),
        "faster_than_real_time": driven_s / wall_s,
    }
    return {**latency, "figures": report.write_figures(out, latency)}


def _add_vehicle_arguments(parser: argparse.ArgumentParser) -> None:
    runs_help = "episodes of each loop and of each lag"
    _add_shared(parser, ("compare", "sweep"), 50, runs_help, 0.95)
    rigs = "simulators in real time side by side, each with a vehicle of its own"
    parser.add_argument("--rigs", type=positive, default=4, metavar="N", help=rigs)
    mock = "a parameter of the mock Hunter, as in python -m hil_tests mock_hunter"
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=mock)
    only = "only these points of the sweep, in ms, as in 50+100,200+300 (default: a table)"
    shape = "DEAD+CONSTANT,..."
    parser.add_argument("--lags", type=_lags, default=sweep.LAGS, metavar=shape, help=only)


def _lags(text: str) -> list[sweep.Lag]:
    lags = []
    for point in text.split(","):
        dead, _, constant = point.partition("+")
        if not (dead.isdecimal() and constant.isdecimal() and int(constant) > 0):
            raise argparse.ArgumentTypeError(
                f"{point!r} is no lag: write DEAD+CONSTANT in ms, as in 50+100"
            )
        lags.append(sweep.Lag(int(dead), int(constant)))
    return list(dict.fromkeys(lags))


def _run_vehicle(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where the vehicle in the loop is below the target."""
    out, target, holds = Path(arguments.out), arguments.target, True
    report.check_report(out)
    task = _task(arguments, read_changes(arguments.set))
    make_parameters(sweep.MODEL, task.changes)  # refuses what the mock does not know
    result: dict[str, Any] = {"command": _this_command(), "policy_id": task.policy_id}
    title = f"# Vehicle in the loop: {task.policy.name}, {arguments.scenario}"
    text = [title, "", f"`{_this_command()}`"]
    if arguments.only != "sweep":
        result["comparison"] = found = run_comparison(task, target, arguments.rigs, out)
        text += ["", "## In real time", "", report.render_comparison(found)]
        print(report.comparison_verdict(found))
        holds = found["holds"]
    if arguments.only != "compare":
        jobs, keep, drive = arguments.jobs or cores(), _rows_beside(out), sweep.drive_lag
        parts = sweep.drive_all(task, arguments.lags, task.runs, drive, jobs, keep, processes=True)
        rows = {lag.spec: row for lag, (row,) in parts.items()}
        lag_budget = sweep.lag_budget(list(rows.values()), target)
        found = {**task.facts(), "mock": task.changes, "rows": rows, "lag_budget": lag_budget}
        result["sweep"] = found
        text += ["", "## Lag, in virtual time", "", report.render_sweep(found)]
        print(report.lag_sentence(found))
    report.write_report(out, result, text)
    return 0 if holds else 1


def drive_loop(task: sweep.Task, part: sweep.Part) -> list[dict[str, Any]]:
    """Drive a part in real time from a stand, with or without a mock Hunter in the loop."""
    options = ("--clock", "realtime", "--loop", part.point, "--standing")
    limit_s = LONGEST_EPISODE_S * (1 + part.runs)
    driven = sweep.run_rig(task, part, limit_s, *options, hunter=part.point == sweep.VEHICLE)
    return [sweep.worth_keeping(driven)]


def run_comparison(task: sweep.Task, target: float, rigs: int, out: Path) -> dict[str, Any]:
    """Drive both loops, ``rigs`` at a time; the report's part ``comparison``."""
    found = sweep.drive_all(task, sweep.LOOPS, LOOP_EPISODES, drive_loop, rigs, _rows_beside(out))
    rows = {loop: sweep.make_row(loop, parts) for loop, parts in found.items()}
    return {
        **task.facts(),
        "mock": task.changes,
        "rows": rows,
        "cost": sweep.cost(rows[sweep.POLICY]["per_episode"], rows[sweep.VEHICLE]["per_episode"]),
        "target_success": target,
        "holds": rows[sweep.VEHICLE]["success"]["value"] >= target,
    }


CAMPAIGN = Command(
    examples(
        "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
        "python -m hil_tests campaign --only faults --rows 'hunter_*' --out runs/faults.json",
    ),
    _add_campaign_arguments,
    _run_campaign,
)
VEHICLES = Command(
    examples(
        "python -m hil_tests vehicle --out runs/vehicle.json",
        "python -m hil_tests vehicle --only sweep --lags 50+100,200+300 --out runs/lags.json",
    ),
    _add_vehicle_arguments,
    _run_vehicle,
)
