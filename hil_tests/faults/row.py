"""A row of the fault table.

A new row is a function that takes a driving rig and the number of its try, does the fault once,
undoes it, and returns a `Try`; `fault` above it puts it into ROWS. The modules with rows are named
in `run.py`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

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
    done: str, expected: str, measured: str, name: str = "", **options: Any
) -> Callable[[DoFault], DoFault]:
    """Put a function into the table, by its own name; ``options`` are those of `Row`."""

    def add(run: DoFault) -> DoFault:
        ROWS.append(Row(name or run.__name__, done, expected, measured, run, **options))
        return run

    return add


drives_on = partial(fault, measured=GAP, recovery_limit_s=None, flows=True)
"""A fault through which the drive goes on."""


def at_any_phase(number: int) -> None:
    """Wait a part of the control period, so that faults do not all come at the same moment."""
    time.sleep(float(np.random.default_rng(number).uniform(0, CONTROL_PERIOD_S)))


def sleep_until(time_s: float) -> None:
    """Sleep until a moment of the monotonic clock."""
    time.sleep(max(0.0, time_s - time.monotonic()))


def drove_on(
    rig: Rig,
    begin_s: float,
    end_s: float,
    wanted: Counter[str] | None = None,
    counted: Counter[str] | None = None,
    **more: Any,
) -> Try:
    """The try of a row in which nothing was to happen between two moments, but perhaps counting.

    ``wanted`` messages had to be rejected, by reason, and ``counted`` ones were; ``more`` are
    further fields of the `Try`.
    """
    wanted, counted = wanted or Counter(), counted or Counter()
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not tell.
    wrong += [*stops_between(rig.timeline.commands, begin_s, end_s), *more.pop("wrong", [])]
    return Try(rig.longest_gap(begin_s, end_s), rejected=dict(counted), wrong=wrong, **more)
