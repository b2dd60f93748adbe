"""Probes: what `hil_tests board` and `deploy push` need."""

from __future__ import annotations

from collections.abc import Callable

from hil_tests.doctor.check import MissingError


def board(name: str) -> Callable[[], str]:
    """A probe: this machine can be the board, as `hil_tests board` would find out."""

    def probe() -> str:
        from hil_tests.board import why_not

        if reason := why_not(name):
            raise MissingError(reason)
        return f"hil_tests board --boards {name} can run"

    return probe
