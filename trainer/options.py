"""Options that several commands share, and their checks."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from edge_runtime import files
from edge_runtime.errors import UserError
from edge_runtime.latency.model import GRAMMAR
from edge_runtime.option_types import positive_number, whole_number
from trainer.scenarios import SCENARIOS
from trainer.training.config import MOST_THREADS


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """``--scenario``."""
    parser.add_argument(
        "--scenario", choices=list(SCENARIOS), default="left_turn", help="which drive"
    )


def add_threads(parser: argparse.ArgumentParser) -> None:
    """``--threads``."""
    parser.add_argument(
        "--threads",
        # torch asks the system for as many at once, and dies where it has none.
        type=whole_number(0, MOST_THREADS),
        default=0,
        metavar="N",
        help="processor threads of the learner; 0: all cores",
    )


def add_latency(parser: argparse.ArgumentParser, what: str) -> None:
    """``--latency``, as it is typed: a run's config keeps the text."""
    parser.add_argument(
        "--latency",
        metavar="SPEC",
        default="none",
        help=f"{what}, in virtual time: {GRAMMAR}".replace("%", "%%"),
    )


def set_threads(count: int) -> None:
    """Limit torch's threads; 0 leaves them as they are."""
    if count:
        import torch  # takes two seconds, which whoever asks for help need not wait

        torch.set_num_threads(count)


def check_picture(out: str, film: bool = False) -> None:
    """Refuse a name that says something else than what will be in it; raises UserError.

    Args:
        out: the file.
        film: whether the command also makes films.
    """
    if film and not out.endswith((".png", ".gif")):
        raise UserError(f"--out {out}: a picture is a .png, a film a .gif")
    if not film and not out.endswith(".png"):
        raise UserError(f"--out {out}: a picture is a .png")


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        UserError: no file, or something else in it.
    """
    value = files.read_json(path, what)
    if not isinstance(value, dict):
        raise UserError(f"{what} {path} holds no JSON object")
    return value


def existing_directory(path: str, what: str) -> Path:
    """A directory that is there.

    Raises:
        UserError: it is not.
    """
    directory = Path(path)
    if not directory.is_dir():
        raise UserError(f"{what} {path} does not exist")
    return directory


Part = TypeVar("Part")


def add_time_limit(parser: argparse.ArgumentParser, what: str) -> None:
    """``--max-minutes``; ``what`` says what becomes of the work then."""
    parser.add_argument(
        "--max-minutes",
        type=positive_number,
        default=None,
        metavar="MIN",
        help=f"{what} (default: no limit)",
    )


def deadline_s(arguments: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> float:
    """When the minutes from now are over, as of ``clock``; infinity without a limit."""
    limit = arguments.max_minutes
    return math.inf if limit is None else clock() + 60.0 * limit


def until(end_s: float, parts: Iterable[Part]) -> Iterator[Part]:
    """The parts that begin by then, as of ``time.monotonic()``, and the first in any case."""
    for part in parts:
        yield part
        if time.monotonic() > end_s:
            return
