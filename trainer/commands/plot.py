"""Draw the learning curve of a run."""

from __future__ import annotations

import argparse

from edge_runtime.cli import examples
from trainer.commands.options import existing_directory
from trainer.plots import write_learning_curve

EXAMPLE = examples("python -m trainer plot runs/phil_1")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run_dir", metavar="RUN_DIR", help="directory of a training run")


def run(arguments: argparse.Namespace) -> int:
    """Draw; returns the exit status."""
    print(write_learning_curve(existing_directory(arguments.run_dir, "run directory")))
    return 0
