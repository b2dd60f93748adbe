"""The table of faults: what a row and a try are, and how a function gets into the table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from hil_tests.faults.observe import REACTION_LIMIT_S, RECOVERY_LIMIT_S
from hil_tests.faults.rig import Rig

GAP = "longest gap between commands"


@dataclass(frozen=True)
class Try:
    """One fault, done and undone.

    ``reaction_s``: from the last good state to the safe stop on the wire (in the log where the
    wire is cut), or to the other end's own brake; None where nothing was to react.
    ``recovery_s``: from the fault's end to the first drive command; None where none is due.
    """

    reaction_s: float | None = None
    recovery_s: float | None = None
    reason: str = ""
    wrong: list[str] = field(default_factory=list)
    """What was not as the row expects, beside the times."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    figures: Mapping[str, float] = field(default_factory=dict)
    """Further figures of the row, by name with unit."""


DoFault = Callable[[Rig, int], Try]
"""Called with a rig that drives and the number of the try, which is its seed, too."""


@dataclass(frozen=True)
class Row:
    """A row of the table of faults."""

    name: str
    done: str
    expected: str
    measured: str
    run: DoFault
    reaction_limit_s: float | None = REACTION_LIMIT_S
    recovery_limit_s: float | None = RECOVERY_LIMIT_S
    rig: Mapping[str, Any] = field(default_factory=dict)  # Options of the Rig
    policy: str = "given"  # ``given``, or one of `run.POLICIES`.
    flows: bool = False
    """Whether the simulator's states go on through the fault: where they do not, the machine stood
    still, and the try is done again (and counted as disturbed)."""
    alone: bool = False  # Whether it needs the machine for itself
    goes_on: bool = False  # Whether the drive goes on through the fault
    counted: Literal["", "edge", "simulator"] = ""
    """Who must have counted just the messages that a try sent to be rejected. The simulator tells
    when the drive has ended: each try then has a rig of its own."""


ROWS: list[Row] = []


def fault(
    expected: str, measured: str, name: str = "", done: str = "", **options: Any
) -> Callable[[DoFault], DoFault]:
    """Put a function into the table, under its name and docstring or ``name`` and ``done``.

    ``options`` are those of `Row`.
    """

    def add(run: DoFault) -> DoFault:
        said = done or " ".join((run.__doc__ or "").split()).rstrip(".")
        ROWS.append(Row(name or run.__name__, said, expected, measured, run, **options))
        return run

    return add


def drives_on(expected: str = "drives on", **options: Any) -> Callable[[DoFault], DoFault]:
    """Put a fault into the table through which the drive goes on.

    The function returns what else is to be judged; ``rejected`` are the messages that it sent to be
    rejected.
    """
    through: dict[str, Any] = {"goes_on": True, "recovery_limit_s": None, "flows": True, **options}
    return fault(expected, GAP, **through)
