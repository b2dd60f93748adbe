"""``--max-minutes``: work that may be ended by the clock, between two of its parts."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from edge_runtime.cli import positive_number

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
