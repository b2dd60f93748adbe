"""``python -m hil_tests pictures``: makes the pictures of the READMEs, all or some."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import check_writable, make_directory
from edge_runtime.util import UserError
from hil_tests.pictures import curves, loop, rerun_view, scenes

PICTURES: dict[str, Callable[[Path, Path], None]] = {
    "left_turn.png": scenes.left_turn,
    "congestion.png": scenes.congestion,
    "policy_sees.png": scenes.policy_sees,
    "take_over.gif": scenes.take_over,
    "cockpit.png": scenes.cockpit,
    "learning_curve.png": curves.learning_curve,
    "success_against_latency.png": curves.success_against_latency,
    "loop.png": loop.loop,
    "rerun.png": rerun_view.rerun_loop,
    "rerun_training.png": rerun_view.rerun_training,
}
"""File -> writes it, given its path and a directory for what is made on the way."""
SOME_MISSING = 1
"""Exit status where a picture could not be made here."""
EXAMPLE = examples(
    "python -m hil_tests pictures --out docs",
    "python -m hil_tests pictures take_over.gif loop.png --out runs",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names", metavar="NAME", nargs="*", help=f"of {', '.join(PICTURES)} (default: all)"
    )
    parser.add_argument("--out", metavar="DIR", default="docs", help="where they go")
    parser.add_argument(
        "--work",
        metavar="DIR",
        help="keep what is made on the way (default: thrown away)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Make them; returns the exit status.

    Raises:
        UserError: no such picture, or nowhere to put it.
    """
    names = arguments.names or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            raise UserError(f"no picture {name!r}: choose from {', '.join(PICTURES)}")
    out = Path(arguments.out)
    for name in names:
        check_writable(out / name)
    if arguments.work is not None:
        make_directory(Path(arguments.work))
        return _make(names, out, Path(arguments.work))
    with tempfile.TemporaryDirectory(prefix="phil-pictures-") as work:
        return _make(names, out, Path(work))


def _make(names: list[str], out: Path, work: Path) -> int:
    """Make each; one that cannot be made here does not keep the others from it."""
    missing = []
    for name in names:
        try:
            PICTURES[name](out / name, work)
        except UserError as error:
            missing.append(name)
            print(f"{name}: not made: {error}", file=sys.stderr)
        else:
            print(f"{out / name}: {(out / name).stat().st_size / 1000:.0f} kB")
    return SOME_MISSING if missing else 0
