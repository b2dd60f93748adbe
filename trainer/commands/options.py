"""Options that several commands share, and their checks."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from edge_runtime.errors import UserError
from trainer.scenarios import SCENARIOS


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """``--scenario``."""
    parser.add_argument(
        "--scenario", choices=list(SCENARIOS), default="left_turn", help="which drive"
    )


def add_threads(parser: argparse.ArgumentParser) -> None:
    """``--threads``."""
    parser.add_argument(
        "--threads",
        type=positive,
        default=None,
        metavar="N",
        help="processor threads of the learner (default: all cores)",
    )


def set_threads(count: int | None) -> None:
    """Limit torch's threads; results are reproducible for one count."""
    if count is not None:
        torch.set_num_threads(count)


def positive(text: str) -> int:
    """An argparse type: an integer above zero."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not above zero")
    return value


def not_negative(text: str) -> int:
    """An argparse type: an integer of at least zero."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
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
