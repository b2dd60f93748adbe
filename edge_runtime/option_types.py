"""Types of command-line options: numbers within limits, with an error that says which.

Each is to be given to argparse as ``type=``.
"""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from typing import Callable

__all__ = [
    "not_negative",
    "not_negative_number",
    "number",
    "positive",
    "positive_number",
    "seconds",
    "share",
    "whole_number",
]

_LARGEST = 2**63 - 1


def whole_number(least: int, most: int = _LARGEST) -> Callable[[str], int]:
    """A type: a whole number between two limits, both included."""
    limits = f", at least {least}" if most == _LARGEST else f" from {least} to {most}"

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value > _LARGEST:
            raise ArgumentTypeError(f"{text!r} is larger than 2**63 - 1")
        if not least <= value <= most:
            raise ArgumentTypeError(f"{text!r} is not a whole number{limits}")
        return value

    return read


def number(limits: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """A type: a finite number that ``fits``; ``limits`` says in words which do."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and fits(value)):
            raise ArgumentTypeError(f"{text!r} is not {limits}")
        return value

    return read


positive = whole_number(1)
not_negative = whole_number(0)
"""Fits into 63 bits, as the seeds of numpy and torch must."""
positive_number = number("a finite number above 0", lambda value: value > 0.0)
not_negative_number = number("a finite number, at least 0", lambda value: value >= 0.0)
seconds = number("a finite number of seconds, at least 0", lambda value: value >= 0.0)
share = number("a share above 0 and at most 1", lambda value: 0.0 < value <= 1.0)
