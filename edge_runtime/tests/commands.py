"""A command of `python -m PACKAGE`, run in the process of the test."""

from __future__ import annotations

from typing import Callable, List

from edge_runtime.cli import run_cli


def exit_status(main: Callable[[List[str]], int], arguments: List[str]) -> int:
    """The status with which the command ends, also where argparse ends it."""
    try:
        return run_cli(main, arguments)
    except SystemExit as end:
        return int(end.code or 0)
