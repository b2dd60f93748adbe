"""Option values that several of hil_tests' commands take, and the command itself, for reports."""

from __future__ import annotations

import argparse
import shlex
import sys

from trainer.commands.options import positive


def several(text: str) -> int:
    """Read how many episodes a share of successes is taken over: at least 2."""
    count = positive(text)
    if count < 2:
        raise argparse.ArgumentTypeError(f"{text} is too few: 2 or more have an interval")
    return count


def share(text: str) -> float:
    """Read a share above 0, at most 1."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not a share above 0 and at most 1")
    return value


def this_command() -> str:
    """The command line that makes a report, to stand in it."""
    return "python -m hil_tests " + shlex.join(sys.argv[1:])
