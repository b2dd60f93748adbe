"""Run the paper's experiments, draw their figures and hold the results against its claims."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path

import torch

from edge_runtime.cli import examples
from edge_runtime.errors import UserError
from edge_runtime.option_types import not_negative, whole_number
from trainer.commands.time_limit import add_time_limit, deadline_s
from trainer.experiments import timing
from trainer.experiments.catalogue import NAMES, TIME, units_of
from trainer.experiments.plan import PLAN, QUICK
from trainer.experiments.ray_runner import import_ray, run_on_ray
from trainer.experiments.report import (
    directory_of,
    draw_experiment,
    outcome_line,
    print_status,
    warn_of_obstacles,
)
from trainer.experiments.runner import FAILED, Tally, run_units
from trainer.experiments.store import Store
from trainer.experiments.summary import (
    CLAIMS,
    COUNTS,
    UNITS,
    claim_lines,
    count_lines,
    has_place,
    write_table,
)
from trainer.experiments.unit_table import unit_lines
from trainer.experiments.units import Unit, human_file
from trainer.experiments.work import BUSY, FINISHED, STOPPED, Task
from trainer.parallel import cores
from trainer.scenarios import SCENARIOS

EXAMPLE = examples(
    "python -m trainer experiment status",
    "python -m trainer experiment fig7 fig9 --jobs 2 --max-minutes 60",
    "python -m trainer experiment all --scenario congestion",
)
ALL, STATUS, SUMMARY = "all", "status", "summary"
DEFAULT_SEEDS = 3
MOST_SEEDS = 1000
"""Far beyond what anybody can compute; and each is a row of every table's work."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names",
        nargs="+",
        metavar="NAME",
        choices=[*NAMES, ALL, STATUS, SUMMARY],
        help=f"{', '.join(NAMES)}; {ALL}; {STATUS}: what is done, running and missing; "
        f"{SUMMARY}: write the tables of RESULTS/README.md again",
    )
    parser.add_argument(
        "--seeds",
        type=whole_number(1, MOST_SEEDS),
        default=DEFAULT_SEEDS,
        help="seeds of each training run",
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="processes of one thread each; 0: one a core",
    )
    parser.add_argument(
        "--scenario",
        choices=list(SCENARIOS),
        help="compute what there is in this one only (default: in both)",
    )
    add_time_limit(
        parser,
        "begin nothing after this time, and stop what runs at its next checkpoint, five "
        "episodes apart; the same command goes on from there",
    )
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="learners' device")
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="compute on a Ray cluster instead of this machine: HOST:PORT, auto or local",
    )
    parser.add_argument(
        "--draw-only", action="store_true", help="draw and judge what is there; compute nothing"
    )
    parser.add_argument(
        "--results",
        default="results",
        metavar="DIR",
        help="results and figures, to be committed",
    )
    parser.add_argument(
        "--runs",
        default="runs",
        metavar="DIR",
        help="checkpoints and actors, not committed",
    )
    parser.add_argument(
        "--humans",
        metavar="DIR",
        help="holds a human model for each scenario: DIR/left_turn, ... (default: RESULTS/humans)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a few episodes of everything, kept in RUNS/quick: a look whose figures mean nothing",
    )


def run(arguments: argparse.Namespace) -> int:
    """Compute, draw and judge; returns the exit status."""
    _check_names(arguments)
    store, names = _store(arguments), _names(arguments.names)
    _check_places(arguments, store)
    _check_scenario(arguments, names)
    if STATUS in arguments.names:
        print_status(store, names, arguments.seeds)
        return 0
    tally = Tally(0)
    if not arguments.draw_only and names:
        tally = _compute(arguments, store, units_of(names, arguments.seeds, arguments.scenario))
    for name in names:
        untimed = tally.count(STOPPED) > 0 or arguments.scenario not in (None, timing.SCENARIO)
        verdict = draw_experiment(
            store, name, arguments.seeds, arguments.device, arguments.draw_only or untimed
        )
        print(outcome_line(verdict, directory_of(store, name)))
    _write_tables(store, arguments.seeds, wanted=SUMMARY in arguments.names)
    _say_what_is_left(tally)
    return 1 if tally.count(FAILED) else 0


def _write_tables(store: Store, seeds: int, wanted: bool) -> None:
    readme = store.results / "README.md"
    for place, lines in (
        (COUNTS, partial(count_lines, store.results, NAMES)),
        (UNITS, partial(unit_lines, store, seeds)),
        (CLAIMS, partial(claim_lines, store.results, NAMES)),
    ):
        if has_place(readme, place):
            write_table(readme, place, lines())
            print(f"{place.what}: {readme}")
        elif wanted:
            raise UserError(f"{readme} has no line {place.begin!r} for the table")


def _check_names(arguments: argparse.Namespace) -> None:
    if {STATUS, SUMMARY} <= set(arguments.names):
        raise UserError(f"{STATUS} and {SUMMARY} are two commands")


def _check_places(arguments: argparse.Namespace, store: Store) -> None:
    """A typing error must not empty the tables of what is there."""
    some_human = any(human_file(scenario, store.humans).is_file() for scenario in SCENARIOS)
    if arguments.humans and not some_human:
        raise UserError(f"--humans {arguments.humans} holds a human model for no scenario")
    if arguments.draw_only and not store.results.is_dir():
        raise UserError(f"there are no results to draw from: no directory {store.results}")


def _check_scenario(arguments: argparse.Namespace, names: list[str]) -> None:
    scenario = arguments.scenario
    if scenario is None:
        return
    if arguments.draw_only or STATUS in arguments.names:
        raise UserError("--scenario chooses what is computed, and this computes nothing")
    timed = TIME in names and scenario == timing.SCENARIO
    if not timed and not units_of(names, arguments.seeds, scenario):
        raise UserError(f"{', '.join(arguments.names)}: nothing to compute in {scenario}")


def _store(arguments: argparse.Namespace) -> Store:
    results, runs = Path(arguments.results), Path(arguments.runs)
    humans = Path(arguments.humans) if arguments.humans else results / "humans"
    if arguments.quick:
        return Store(QUICK, runs / "quick" / "results", runs / "quick", humans)
    return Store(PLAN, results, runs, humans)


def _names(given: list[str]) -> list[str]:
    """The experiments that are meant, in the catalogue's order."""
    chosen = set(given)
    if ALL in chosen or chosen == {STATUS}:
        return list(NAMES)
    return [name for name in NAMES if name in chosen]


def _compute(arguments: argparse.Namespace, store: Store, units: list[Unit]) -> Tally:
    if arguments.device == "cuda" and not arguments.ray and not torch.cuda.is_available():
        raise UserError("no CUDA device is available; use --device cpu")
    if arguments.ray:
        import_ray()  # said before anything else is
    # The clock that other processes, perhaps on other machines, have, too.
    stop_at_s = deadline_s(arguments, time.time)
    left = [unit for unit in warn_of_obstacles(store, units) if not store.done(unit)]
    if not left:
        return Tally(0)
    tasks = [Task(unit, store, arguments.device, stop_at_s) for unit in left]
    if arguments.ray:
        return run_on_ray(tasks, arguments.ray)
    return run_units(tasks, arguments.jobs or cores())


def _say_what_is_left(tally: Tally) -> None:
    if tally.total and tally.count(FINISHED) < tally.total:
        ends = ((STOPPED, "stopped for lack of time"), (BUSY, "elsewhere"), (FAILED, "failed"))
        said = ", ".join(f"{tally.count(end)} {words}" for end, words in ends if tally.count(end))
        print(f"{tally.count(FINISHED)} of {tally.total} units computed, {said}; "
              "the same command goes on")  # fmt: skip
