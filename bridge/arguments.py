"""Option values of the bridge's commands, checked; a wrong one ends in one line and status 2."""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError


def positive_int(text: str) -> int:
    """Read an integer of at least 1."""
    return _int_from(text, 1)


def non_negative_int(text: str) -> int:
    """Read an integer of at least 0."""
    return _int_from(text, 0)


def non_negative_seconds(text: str) -> float:
    """Read a finite number of seconds, at least 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise ArgumentTypeError(f"{text!r} is not a number of seconds, at least 0")
    return seconds


def add_tls(parser: ArgumentParser) -> None:
    """Declare ``--tls``; its value goes through ``edge_runtime.tls.tls_for``."""
    parser.add_argument(
        "--tls",
        metavar="DIR",
        help="ca.pem, cert.pem, key.pem of this party (python -m deploy certs); endpoint tls/...",
    )


def _int_from(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise ArgumentTypeError(f"{text!r} is not a whole number, at least {least}")
    return value
