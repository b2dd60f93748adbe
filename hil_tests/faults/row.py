"""A row of the fault table.

A new row is a function that takes a driving rig and the number of its try, does the fault once,
undoes it, and returns a `Try`; its docstring says what is done. `fault` or `drives_on` above it
puts it into ROWS. The modules with rows are named in `run.py`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from edge_runtime.wire import CONTROL_PERIOD_S
from hil_tests.faults.observe import REACTION_LIMIT_S, RECOVERY_LIMIT_S, stops_between
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
    notes: list[str] = field(default_factory=list)
    """What explains a time, and is no fault by itself."""


DoFault = Callable[[Rig, int], Try]
"""Called with a rig that drives and the number of the try, which is its seed, too."""


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    name: str
    done: str
    expected: str
    measured: str
    run: DoFault
    reaction_limit_s: float | None = REACTION_LIMIT_S
    recovery_limit_s: float | None = RECOVERY_LIMIT_S
    rig: Mapping[str, Any] = field(default_factory=dict)
    """Options of the Rig."""
    policy: str = "given"
    """``given``, or one of `run.POLICIES`."""
    flows: bool = False
    """Whether the simulator's states go on through the fault: where they do not, the machine stood
    still, and the try is done again (and counted as disturbed)."""
    alone: bool = False
    """Whether it needs the machine for itself."""
    new_rig_each_try: bool = False
    by_arrival: bool = False
    """Whether the age of an answer is taken by the probe's clock (the edge's is stepped)."""


ROWS: list[Row] = []


def fault(
    expected: str, measured: str, name: str = "", done: str = "", **options: Any
) -> Callable[[DoFault], DoFault]:
    """Put a function into the table.

    Its own name and its docstring stand there, or ``name`` and ``done`` where several rows share
    it; ``options`` are those of `Row`.
    """

    def add(run: DoFault) -> DoFault:
        said = done or " ".join((run.__doc__ or "").split()).rstrip(".")
        ROWS.append(Row(name or run.__name__, said, expected, measured, run, **options))
        return run

    return add


def drives_on(
    expected: str = "drives on", counted: Literal["", "edge", "simulator"] = "", **options: Any
) -> Callable[[DoFault], DoFault]:
    """As `fault`, for one through which the drive goes on.

    The function returns what else is to be judged; ``rejected`` are the messages that it sent to be
    rejected. Who ``counted`` them must have counted just these. The simulator's counts stand in its
    report, for which the drive has to end.
    """
    if counted == "simulator":
        options = {"flows": False, "new_rig_each_try": True, **options}

    def add(do: DoFault) -> DoFault:
        def run(rig: Rig, number: int) -> Try:
            before = rig.edge_counts() if counted == "edge" else Counter()
            begin_s = time.monotonic()
            done = do(rig, number)
            end_s = time.monotonic()
            found = Counter(done.rejected)
            if counted == "edge":
                found = rig.edge_counts() - before
            if counted == "simulator":
                rig.end_drive()
                found = rig.simulator_counts()
            return drove_on(rig, begin_s, end_s, done, found)

        run.__doc__, run.__name__ = do.__doc__, do.__name__
        through: dict[str, Any] = {"recovery_limit_s": None, "flows": True, **options}
        return fault(expected, GAP, **through)(run)

    return add


def drove_on(rig: Rig, begin_s: float, end_s: float, done: Try, counted: Counter[str]) -> Try:
    """Judge a try through which the drive was to go on, and what was counted in it."""
    wanted = Counter(done.rejected)
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not tell.
    wrong += [*stops_between(rig.timeline.commands, begin_s, end_s), *done.wrong]
    gap_s = rig.longest_gap(begin_s, end_s)
    return replace(done, reaction_s=gap_s, rejected=dict(counted), wrong=wrong)


def at_any_phase(number: int) -> None:
    """Wait a part of the control period, so that faults do not all come at the same moment."""
    time.sleep(float(np.random.default_rng(number).uniform(0, CONTROL_PERIOD_S)))


def sleep_until(time_s: float) -> None:
    """Sleep until a moment of the monotonic clock."""
    time.sleep(max(0.0, time_s - time.monotonic()))
