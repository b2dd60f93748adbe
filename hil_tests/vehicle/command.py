"""``python -m hil_tests vehicle``: what the actuators of a vehicle cost, and what they may cost."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from bridge.environments import CONDITIONS, NOMINAL
from bridge.signals import sigterm_as_interrupt
from edge_runtime.cli import ArgumentParser, add_public_key, examples
from edge_runtime.errors import UserError
from edge_runtime.option_types import not_negative, positive, share
from edge_runtime.policy import load_policy
from hil_tests.commands import end_children
from hil_tests.mock_hunter.parameters import make_parameters, read_changes
from hil_tests.options import several, this_command
from hil_tests.reports import check_report, write_report
from hil_tests.vehicle.comparison import PART_EPISODES, run_comparison
from hil_tests.vehicle.figures import write_figures
from hil_tests.vehicle.lag_axes import LAGS, Lag
from hil_tests.vehicle.render import lag_sentence, render_comparison, render_sweep, verdict
from hil_tests.vehicle.rigs import VEHICLE, Drive
from hil_tests.vehicle.sweep import MODEL, SweepTask, kept_points, run_sweep
from trainer.evaluate import cores
from trainer.options import add_scenario
from trainer.util import ProgressBar

PARTS = ("compare", "sweep")

EXAMPLE = examples(
    "python -m hil_tests vehicle --out runs/vehicle.json",
    "python -m hil_tests vehicle --only sweep --lags 50+100,200+300 --runs 20 --out runs/lags.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out",
        required=True,
        metavar="R.json",
        help="the report; R.md, pictures and R_rows/ (points that are done) go beside it",
    )
    parser.add_argument(
        "--policy",
        metavar="P.onnx",
        help="policy file (default: results/policies/SCENARIO.onnx)",
    )
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument("--condition", choices=CONDITIONS, default=NOMINAL, help="scene")
    parser.add_argument("--only", choices=PARTS, help="one part (default: both)")
    parser.add_argument(
        "--runs", type=several, default=50, help="episodes of each loop and of each lag"
    )
    parser.add_argument("--seed", type=not_negative, default=0, help="of the first episode")
    parser.add_argument(
        "--target", type=share, default=0.95, help="success that is asked of the vehicle"
    )
    parser.add_argument(
        "--rigs",
        type=positive,
        default=4,
        metavar="N",
        help="simulators in real time side by side, each with a vehicle of its own",
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="processes of the sweep, which is in virtual time; 0: one a core",
    )
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
    policy = Path(arguments.policy or f"results/policies/{arguments.scenario}.onnx")
    # The edge runtime checks signatures where it matters; here the loop is measured.
    policy_id = load_policy(str(policy), arguments.public_key, allow_unsigned=True).policy_id
    changes = read_changes(arguments.set)
    make_parameters(MODEL, changes)  # refuses what the mock does not know, before anything runs
    lags = _lags(arguments.lags)
    report: dict[str, Any] = {"command": this_command(), "policy_id": policy_id}
    text = [
        f"# Vehicle in the loop: {policy.name}, {arguments.scenario}",
        "",
        f"`{this_command()}`",
    ]
    with sigterm_as_interrupt():  # Whoever ends it ends its processes.
        if arguments.only != "sweep":
            report["comparison"] = _compare(arguments, policy, changes)
            text += ["", "## In real time", "", render_comparison(report["comparison"])]
        if arguments.only != "compare":
            report["sweep"] = _sweep(arguments, policy, policy_id, changes, lags)
            figures = write_figures(out, report["sweep"])
            report["sweep"]["figures"] = figures
            text += ["", "## Lag, in virtual time", "", render_sweep(report["sweep"], figures)]
    write_report(out, report, text)
    return _conclude(out, report)


def _compare(
    arguments: argparse.Namespace, policy: Path, changes: dict[str, float]
) -> dict[str, Any]:
    drive = Drive(
        policy, arguments.scenario, arguments.condition, VEHICLE, arguments.seed, arguments.runs,
        changes, arguments.public_key,
    )  # fmt: skip
    count = 2 * math.ceil(arguments.runs / PART_EPISODES)
    with ProgressBar("drives", count) as bar:

        def on_part(report: dict[str, Any]) -> None:
            bar.advance({"success": f"{report['success_rate']:.2f}", "loop": report["loop"]})

        try:
            return run_comparison(drive, arguments.target, arguments.rigs, on_part)
        except BaseException:
            end_children()
            raise


def _sweep(
    arguments: argparse.Namespace,
    policy: Path,
    policy_id: str,
    changes: dict[str, float],
    lags: list[Lag],
) -> dict[str, Any]:
    task = SweepTask(
        str(policy), arguments.scenario, arguments.condition, arguments.seed, arguments.runs,
        changes, arguments.public_key,
    )  # fmt: skip
    out = Path(arguments.out)
    kept = kept_points(out.with_name(f"{out.stem}_rows"), task, policy_id)
    with ProgressBar("lags", len(lags)) as bar:

        def on_point(row: dict[str, Any]) -> None:
            bar.advance({"success": f"{row['success']['value']:.2f}", "at": row["spec"]})

        return run_sweep(task, lags, arguments.target, arguments.jobs or cores(), kept, on_point)


def _conclude(out: Path, report: dict[str, Any]) -> int:
    holds = True
    if "comparison" in report:
        print(verdict(report["comparison"]))
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
