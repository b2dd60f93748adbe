"""Measure learner, environment, whole training, replay and memory, and compare with peers."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_runtime.cli import UserError, examples, write_json_out
from edge_runtime.files import check_writable
from trainer.benches.effort import FULL, QUICK, Effort
from trainer.benches.environment import measure_environment
from trainer.benches.learner import measure_learner
from trainer.benches.memory import measure_memory
from trainer.benches.replay import measure_replay
from trainer.benches.table import show
from trainer.benches.training import measure_training
from trainer.benches.turns import Tick
from trainer.options import add_threads, set_threads
from trainer.scenarios import SCENARIOS
from trainer.util import ProgressBar, about

EXAMPLE = examples(
    "python -m trainer bench --quick --threads 1",
    "python -m trainer bench --threads 2 --peers .venv-peers/bin/python --out b.json",
)

ROUNDS: dict[str, Callable[[Effort], int]] = {
    "learner": lambda effort: effort.learner_rounds,
    "environment": lambda effort: effort.environment_rounds * len(SCENARIOS),
    "training": lambda effort: effort.training_episodes,
    "replay": lambda effort: 1,
    "memory": lambda effort: 1,
}
"""What can be measured, and how often each moves the progress bar."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="R.json", help="also write the figures to this file")
    parser.add_argument(
        "--only",
        type=_parts,
        default=list(ROUNDS),
        metavar="PART,...",
        help=f"measure these only, of {', '.join(ROUNDS)} (default: all)",
    )
    parser.add_argument(
        "--peers",
        metavar="PYTHON",
        help="an interpreter that has stable-baselines3 (`make bench` makes one); "
        "without it that peer is left out",
    )
    parser.add_argument("--quick", action="store_true", help="few rounds: a look only")
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure and print; returns the exit status."""
    if arguments.out:
        check_writable(arguments.out)
    peers = _interpreter(arguments.peers) if arguments.peers else None
    set_threads(arguments.threads)
    effort = QUICK if arguments.quick else FULL
    with ProgressBar("bench", sum(ROUNDS[name](effort) for name in arguments.only)) as bar:
        report = measure(arguments.only, effort, peers, lambda done: bar.advance({"last": done}))
    show(report)
    write_json_out(arguments.out, report)
    return 0


def measure(parts: list[str], effort: Effort, peers: Path | None, tick: Tick) -> dict[str, Any]:
    """The report: machine and versions, the contract's three figures, and each part in full."""
    work: dict[str, Callable[[], dict[str, Any]]] = {
        "learner": lambda: measure_learner(effort, peers, tick),
        "environment": lambda: measure_environment(effort, tick),
        "training": lambda: measure_training(effort, tick),
        "replay": lambda: _ticked("replay", tick, measure_replay(effort)),
        "memory": lambda: _ticked("memory", tick, measure_memory(effort)),
    }
    figures = {name: work[name]() for name in parts}
    return {**about(), **contract_figures(figures), **figures}


def contract_figures(figures: dict[str, Any]) -> dict[str, Any]:
    """The figures under the names that others read."""
    named: dict[str, Any] = {}
    if "learner" in figures:
        named["learner_ms_per_update"] = figures["learner"]["ms_per_update"]
    if "environment" in figures:
        named["environment_steps_per_s"] = {
            scenario: figure["steps_per_s"] for scenario, figure in figures["environment"].items()
        }
    if "training" in figures:
        named["train_s_per_10k_steps"] = figures["training"]["s_per_10k_steps"]
    return named


def _ticked(name: str, tick: Tick, figures: dict[str, Any]) -> dict[str, Any]:
    tick(name)
    return figures


def _parts(text: str) -> list[str]:
    chosen = text.split(",")
    for name in chosen:
        if name not in ROUNDS:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(ROUNDS)}")
    # In the table's order, each once.
    return [name for name in ROUNDS if name in chosen]


def _interpreter(text: str) -> Path:
    """The path as given: a virtual environment's python is a link that must not be followed."""
    if not (os.path.isfile(text) and os.access(text, os.X_OK)):
        raise UserError(f"--peers {text} is no interpreter; `make bench` makes one in .venv-peers")
    return Path(os.path.abspath(text))
