"""Run the paper's experiments and hold their results against its claims."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from edge_runtime.cli import examples, not_negative, whole_number
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError
from trainer.evaluate import cores
from trainer.experiments import run as running
from trainer.experiments.plan import (
    DEFAULT_SEEDS,
    EXPERIMENTS,
    PLAN,
    QUICK,
    SCENARIOS,
    TIME,
    obstacle,
    units_of,
)
from trainer.experiments.ray_runner import run_on_ray
from trainer.experiments.report import write_report
from trainer.experiments.run import FAILED, FINISHED, Store, Task, say
from trainer.experiments.timing import TIME_FILE, measure
from trainer.options import add_time_limit, deadline_s

EXAMPLE = examples(
    "python -m trainer experiment status",
    "python -m trainer experiment fig7 fig9 --jobs 2 --max-minutes 60",
    "python -m trainer experiment all --scenario congestion",
    "python -m trainer experiment report",
)
ALL, STATUS, REPORT = "all", "status", "report"
MOST_SEEDS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names",
        nargs="+",
        metavar="NAME",
        choices=[*EXPERIMENTS, TIME, ALL, STATUS, REPORT],
        help=f"compute what {', '.join(EXPERIMENTS)} or {ALL} of them need; {TIME}: measure the "
        f"training time; {STATUS}: what is done, running and missing; {REPORT}: draw the figures "
        "and judge the claims from what is done",
    )
    parser.add_argument(
        "--seeds",
        type=whole_number(1, MOST_SEEDS),
        default=DEFAULT_SEEDS,
        help="trainings of each algorithm in each setting",
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="processes of one thread each; 0: one a core",
    )
    parser.add_argument(
        "--scenario", choices=SCENARIOS, help="compute in this one only (default: in both)"
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="compute on a Ray cluster instead of this machine: HOST:PORT, auto or local",
    )
    add_time_limit(
        parser,
        "begin nothing after this time, and stop what runs at its next checkpoint, five "
        "episodes apart; the same command goes on from there",
    )
    parser.add_argument(
        "--results", default="results/paper", metavar="DIR", help="records, figures and report"
    )
    parser.add_argument(
        "--runs", default="runs/paper", metavar="DIR", help="checkpoints and actors"
    )
    parser.add_argument(
        "--humans",
        default="results/humans/paper",
        metavar="DIR",
        help="holds the human model of each scenario: DIR/left_turn, DIR/congestion",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a few steps of everything, kept in RUNS/quick: a look whose numbers mean nothing",
    )


def run(arguments: argparse.Namespace) -> int:
    """Compute, say how things stand, or report; returns the exit status."""
    names = list(dict.fromkeys(arguments.names))
    if len(names) > 1 and {STATUS, REPORT} & set(names):
        raise UserError(f"{STATUS} and {REPORT} stand alone")
    store = _store(arguments)
    if names == [STATUS]:
        print("\n".join(running.status_lines(store, arguments.seeds)))
        return 0
    if names == [REPORT]:
        print(f"wrote {write_report(store, arguments.seeds)}")
        return 0
    status = 0
    if set(names) != {TIME}:
        status = _compute(arguments, store, [name for name in names if name != TIME])
    if TIME in names:
        make_directory(store.results)
        measured = json.dumps(measure(store))
        write_atomic(store.results / TIME_FILE, f"{measured}\n".encode())
    return status


def _store(arguments: argparse.Namespace) -> Store:
    results, runs, humans = map(Path, (arguments.results, arguments.runs, arguments.humans))
    if arguments.quick:
        return Store(QUICK, runs / "quick" / "results", runs / "quick", humans)
    return Store(PLAN, results, runs, humans)


def _compute(arguments: argparse.Namespace, store: Store, names: list[str]) -> int:
    wanted = units_of(names, arguments.seeds, arguments.scenario)
    if names and not wanted:
        raise UserError(f"{', '.join(names)}: nothing to compute in {arguments.scenario}")
    possible = [unit for unit in wanted if not obstacle(unit, store.humans)]
    if len(possible) < len(wanted):
        missing = {str(obstacle(unit, store.humans)) for unit in wanted} - {"None"}
        say(f"{len(wanted) - len(possible)} units left out: {'; '.join(sorted(missing))}")
    # The clock that the processes have, too.
    stop_at_s = deadline_s(arguments, time.time)
    states = store.states(possible)
    left = [Task(unit, store, stop_at_s) for unit in possible if states[unit] != running.DONE]
    if left and arguments.ray:
        ends = run_on_ray(left, arguments.ray)
    else:
        ends = running.run_units(left, arguments.jobs or cores())
    said = ", ".join(f"{count} {end}" for end, count in ends.items())
    print(
        f"{len(possible) - len(left)} of {len(wanted)} units were done{f', {said}' if said else ''}"
    )
    if ends[FINISHED] < len(left):
        print("the same command goes on")
    return 1 if ends[FAILED] else 0
