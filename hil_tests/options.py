"""Option values that several of hil_tests' commands take, and the command itself, for reports."""

from __future__ import annotations

import argparse
import shlex
import sys

from edge_runtime.cli import positive


def several(text: str) -> int:
    """Read how many episodes a share of successes is taken over: at least 2."""
    count = positive(text)
    if count < 2:
        raise argparse.ArgumentTypeError(f"{text} is too few: 2 or more have an interval")
    return count


def trusting(policy: object, public_key: str | None) -> tuple[str, ...]:
    """The edge runtime's options where the loop is measured and whoever made the policy may be."""
    named = () if public_key is None else ("--public-key", public_key)
    return ("--policy", str(policy), "--allow-unsigned", *named)


def this_command() -> str:
    """The command line that makes a report, to stand in it."""
    return "python -m hil_tests " + shlex.join(sys.argv[1:])
