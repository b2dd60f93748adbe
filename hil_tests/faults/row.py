"""What a row of the fault table is, and what a try of it gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hil_tests.faults.rig import Rig
from hil_tests.faults.timeline import REACTION_LIMIT_S, RECOVERY_LIMIT_S


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


@dataclass(frozen=True)
class Row:
    """A row of the table. ``run`` does the fault once on a rig that drives, and undoes it."""

    name: str
    done: str
    expected: str
    measured: str
    run: Callable[[Rig, int], Try]
    """Called with the rig and the number of the try, which is its seed, too."""
    reaction_limit_s: float | None = REACTION_LIMIT_S
    recovery_limit_s: float | None = RECOVERY_LIMIT_S
    rig: Mapping[str, Any] = field(default_factory=dict)
    """Options of the Rig."""
    policy: str = "given"
    """``given``, or ``slow``: one that is slow on bright frames, ``steady``: always the same
    pedal, ``full``: all of it, ``mean``: all of it on bright frames, the brake on others."""
    flows: bool = False
    """Whether the simulator's states go on through the fault: where they do not, the machine stood
    still, and the try is done again (and counted as disturbed)."""
    alone: bool = False
    """Whether it needs the machine for itself."""
    most_tries: int | None = None
    new_rig_each_try: bool = False
    by_arrival: bool = False
    """Whether the age of an answer is taken by the probe's clock (the edge's is stepped)."""
