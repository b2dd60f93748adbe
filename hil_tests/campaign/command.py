"""``python -m hil_tests campaign``: every fault, every latency row, one report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from bridge.environments import CONDITIONS, NOMINAL
from bridge.signals import sigterm_as_interrupt
from edge_runtime.cli import ArgumentParser, add_public_key, examples
from edge_runtime.errors import UserError
from edge_runtime.files import read_json
from edge_runtime.latency.model import parse_spec
from edge_runtime.option_types import not_negative, positive, share
from hil_tests.campaign.axes import AXES, Axis
from hil_tests.campaign.figures import write_figures
from hil_tests.campaign.latency import run_latency
from hil_tests.campaign.render import render_latency
from hil_tests.options import several, this_command
from hil_tests.reports import check_report, write_report
from trainer.evaluate import cores
from trainer.options import add_scenario
from trainer.util import ProgressBar

PARTS = ("latency", "faults")
NO_ROWS = "none"
"""``--rows none``: nothing but what ``--check-realtime`` asks for."""
EXAMPLE = examples(
    "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
    "python -m hil_tests campaign --only latency --rows none --check-realtime 50ms,loss=1% \\\n"
    "    --out runs/realtime.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out",
        required=True,
        metavar="R.json",
        help="the report; R.md, pictures and R_rows/ (what is done already) go beside it",
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
        "--rows",
        metavar="NAME,...",
        help=f"only these latency axes ({', '.join(axis.name for axis in AXES)}) and faults; "
        f"{NO_ROWS}: only what --check-realtime asks for",
    )
    parser.add_argument(
        "--runs", type=several, default=100, help="episodes of each latency row, the same seeds"
    )
    parser.add_argument("--seed", type=not_negative, default=0, help="of each row's first episode")
    parser.add_argument(
        "--clock",
        choices=("lockstep", "realtime"),
        default="lockstep",
        help="of the latency rows: virtual time, or the wall clock (slow)",
    )
    parser.add_argument(
        "--target", type=share, default=0.98, help="success that the latency budget asks for"
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="vehicles at once, each with an edge runtime and an endpoint of its own; "
        "0: one a core; changes no result in virtual time",
    )
    parser.add_argument(
        "--check-realtime",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="drive these networks in real time, too, and say whether success agrees",
    )
    parser.add_argument(
        "--realtime-runs", type=several, default=40, help="episodes of each of those"
    )
    parser.add_argument(
        "--realtime-jobs", type=positive, default=4, metavar="N", help="vehicles at once in those"
    )
    parser.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="NAME=R.json",
        help="show another campaign's curves and budget beside",
    )
    parser.add_argument("--tries", type=positive, default=10, help="of each fault")


def run(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where a fault was not met as it should be."""
    out = Path(arguments.out)
    check_report(out)
    arguments.jobs = arguments.jobs or cores()
    policy = Path(arguments.policy or f"results/policies/{arguments.scenario}.onnx")
    for spec in arguments.check_realtime:
        parse_spec(spec)
    axes, faults = _choose(arguments)
    others = dict(_other(text) for text in arguments.against)
    report: dict[str, Any] = {"command": this_command()}
    text = [f"# Campaign: {policy.name}, {arguments.scenario}", "", f"`{this_command()}`", ""]
    if axes or arguments.check_realtime:
        with sigterm_as_interrupt():  # Whoever ends a campaign ends its processes.
            latency = run_latency(arguments, policy, axes, out.with_name(f"{out.stem}_rows"))
        figures = write_figures(out, latency, others) if axes else {}
        report["latency"] = {**latency, "figures": figures}
        text += ["## Latency", "", render_latency(latency, figures, others)]
    passed = True
    if faults is not None:
        report["faults"], table = _run_faults(arguments, faults)
        passed = report["faults"]["passed"]
        text += ["## Faults", "", table]
    write_report(out, report, text)
    _conclude(out, report)
    return 0 if passed else 1


def _choose(arguments: argparse.Namespace) -> tuple[list[Axis], list[str] | None]:
    """The latency axes, and the faults by name ([]: all of them; None: no faults)."""
    from hil_tests.faults import check_rows

    known = {axis.name: axis for axis in AXES}
    if arguments.rows == NO_ROWS:
        return [], None
    named = arguments.rows.split(",") if arguments.rows else []
    axes = [known[name] for name in named if name in known] if named else list(AXES)
    faults = [name for name in named if name not in known]
    if faults and arguments.only == "latency":
        raise UserError(f"no latency axis {faults[0]!r}; choose from {', '.join(known)}")
    if arguments.only == "faults":
        if named and not faults:
            raise UserError(f"{arguments.rows} names latency axes, no fault")
        axes = []
    check_rows(faults)  # now, not after the hours of the latency rows
    without_faults = arguments.only == "latency" or (named and not faults)
    return axes, None if without_faults else faults


def _run_faults(arguments: argparse.Namespace, names: list[str]) -> tuple[dict[str, Any], str]:
    from hil_tests.faults import render_faults, run_faults

    policy = Path(arguments.policy) if arguments.policy else None
    bar: ProgressBar | None = None

    def on_progress(row: str, done: int, total: int) -> None:
        nonlocal bar
        bar = bar or ProgressBar("faults", total).__enter__()
        bar.advance({"row": row}, done - bar.done)

    try:
        found = run_faults(
            arguments.tries, names or None, policy, on_progress, arguments.jobs,
            arguments.public_key,
        )  # fmt: skip
    finally:
        if bar is not None:
            bar.__exit__()
    return found, render_faults(found)


def _other(text: str) -> tuple[str, dict[str, Any]]:
    name, equals, path = text.partition("=")
    if not equals:
        raise UserError(f"--against {text}: write NAME=R.json")
    try:
        latency: dict[str, Any] = read_json(path, "report")["latency"]
        policy = Path(latency["policy"]).stem
        budget = latency["budget"]
        budget["sentence"] = name + budget["sentence"].removeprefix(policy)
        latency["rows"]
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path} is no report of a latency campaign with its budget") from None
    return name, latency


def _conclude(out: Path, report: dict[str, Any]) -> None:
    latency = report.get("latency")
    if latency and latency["budget"]:
        print(latency["budget"]["sentence"])
    if latency and latency["realtime_check"]:
        verdict = "agrees" if latency["realtime_check"]["agree"] else "does NOT agree"
        print(f"Success in real time {verdict} with virtual time within the intervals.")
    if "faults" in report:
        print("Every fault was met." if report["faults"]["passed"] else "Not every fault was met.")
    print(f"{out} and {out.with_suffix('.md')}")
