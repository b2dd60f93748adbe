"""Draw the learning curve of a run, or of several."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge_runtime.cli import examples
from edge_runtime.files import check_writable
from edge_runtime.util import UserError
from trainer.commands.options import check_picture, existing_directory
from trainer.plots import CURVE_FILE, write_learning_curves

EXAMPLE = examples(
    "python -m trainer plot runs/phil_1",
    "python -m trainer plot runs/phil_1 runs/phil_2 runs/phil_3 --out curves.png",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "run_dirs",
        metavar="RUN_DIR",
        nargs="+",
        help="directory of a training run; several are drawn thinly, and their mean",
    )
    parser.add_argument(
        "--out",
        metavar="F.png",
        help=f"the picture (default: RUN_DIR/{CURVE_FILE})",
    )


def run(arguments: argparse.Namespace) -> int:
    """Draw; returns the exit status."""
    run_dirs = [existing_directory(path, "run directory") for path in arguments.run_dirs]
    if arguments.out is None and len(run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    if arguments.out is not None:
        check_picture(arguments.out)
    out = run_dirs[0] / CURVE_FILE if arguments.out is None else Path(arguments.out)
    check_writable(out)
    write_learning_curves(run_dirs, out)
    print(out)
    return 0
