"""Runs rows of the fault table, several rigs at once, and gathers what each try gave."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from edge_runtime.manifest import Task
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests.faults import hunter, messages  # noqa: F401 (they fill the table)
from hil_tests.faults.observe import (
    later_s,
    longest_gap_s,
    spread_ms,
    stops_between,
    unsafe_commands,
)
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import at_any_phase
from hil_tests.faults.table import Row, Try
from hil_tests.processes import POLICY, in_parallel, trusting
from hil_tests.testing.policies import TASK, write_policy

STALLED_PERIODS = 1.5
"""States further apart than this are not the real-time drive that a row is about."""
MOST_DISTURBED = 100


# Made for the rows that name them: the kind and value of `write_policy`.
POLICIES = {
    "steady": ("constant", 0.6),
    "full": ("constant", 1.0),
    # Brightness is its pedal: full throttle on white frames, the brake on all others.
    "mean": ("mean", 0.0),
}


@dataclass
class Outcome:
    """What all tries of a row gave."""

    tries: list[Try] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    disturbed: int = 0  # Tries in which the machine itself stood still, done again
    failures: list[str] = field(default_factory=list)
    """Tries that came to no end: what should have come was not seen."""


def run_faults(
    chosen: Sequence[Row],
    tries: int,
    policy: Path = POLICY,
    on_try: Callable[[str], None] = lambda row: None,
    jobs: int = 2,
    public_key: str | None = None,
) -> dict[str, Any]:
    """Do every row ``tries`` times, ``jobs`` rigs at once; return a report for JSON.

    ``on_try`` is called with the row's name after every try. Rows that need the machine for
    themselves run after the others. Raises UserError where the policy does not load.
    """
    given = load_policy(policy, public_key, allow_unsigned=True).manifest
    with tempfile.TemporaryDirectory(prefix="phil-faults-") as folder:
        work = Path(folder)
        policies = {"given": trusting(policy, public_key)}
        for kind in {row.policy for row in chosen} & set(POLICIES):
            write_policy(work / f"{kind}.onnx", *POLICIES[kind])
            policies[kind] = trusting(work / f"{kind}.onnx", None)
        outcomes: dict[str, Outcome] = {}
        ended = threading.Event()

        def do(row: Row) -> Outcome:
            task = _task_of(row, given)
            return run_row(row, policies[row.policy], task, work, tries, on_try, ended)

        for alone in (False, True):
            rows = [row for row in chosen if row.alone == alone]
            at_once = 1 if alone else jobs
            in_parallel(do, rows, at_once, lambda row, found: outcomes.update({row.name: found}),
                        ended)  # fmt: skip
    found = [report_row(row, outcomes[row.name], later_s(_task_of(row, given))) for row in chosen]
    return {
        "tries": tries,
        "rows": found,
        "crashes": sum(len(row["crashes"]) for row in found),
        "unsafe_commands": sum(len(row["unsafe"]) for row in found),
        "passed": all(row["passed"] for row in found),
    }


def _task_of(row: Row, given: Task) -> Task:
    """Return what the row's policy is made for: only ``given`` ones may differ from `TASK`."""
    return given if row.policy == "given" else TASK


def run_row(
    row: Row,
    trust: Sequence[str],
    task: Task,
    work: Path,
    tries: int,
    on_try: Callable[[str], None],
    ended: threading.Event,
) -> Outcome:
    """Do all tries of a row, each rig in a directory in ``work``; one that hangs is replaced.

    Once the campaign has ``ended``, no more are begun.
    """
    outcome, number = Outcome(), 0
    while number < tries and not ended.is_set():
        try:
            started = Rig(trust, Path(tempfile.mkdtemp(dir=work)), task, **row.rig)
        except (OSError, UserError) as error:  # as where this machine has no multicast
            outcome.failures.append(f"try {number}: {error}")
            break
        with started as rig:
            going = True
            while going and number < tries:
                disturbed = outcome.disturbed
                going = _try(row, rig, number, outcome) and row.counted != "simulator"
                if outcome.disturbed == disturbed:
                    number += 1
                    on_try(row.name)
            seen = rig.timeline
            outcome.unsafe += unsafe_commands(seen.commands, seen.states, task)
            if seen.unreadable:
                outcome.unsafe.append(f"{seen.unreadable} commands that nobody would take")
        outcome.crashes += rig.crashes
    return outcome


def _try(row: Row, rig: Rig, number: int, outcome: Outcome) -> bool:
    """Do a row once; return whether the rig can be used again."""
    try:
        rig.wait_until_driving()
        at_any_phase(number)
        begin_s = time.monotonic()
        done = do_fault(row, rig, number)
    except (OSError, UserError) as error:  # a time-out, or a process that is gone
        outcome.failures.append(f"try {number}: {error}")
        return False
    gap_s = longest_gap_s(list(rig.timeline.flow_s), begin_s, time.monotonic())
    if row.flows and gap_s > STALLED_PERIODS * rig.period_s and outcome.disturbed < MOST_DISTURBED:
        outcome.disturbed += 1
    else:
        outcome.tries.append(done)
    return True


def do_fault(row: Row, rig: Rig, number: int) -> Try:
    """Do the fault of a row once, and judge it where the drive was to go on."""
    before = rig.edge_counts() if row.counted == "edge" else Counter()
    begin_s = time.monotonic()
    done = row.run(rig, number)
    if not row.goes_on:
        return done
    end_s = time.monotonic()
    wanted = counted = Counter(done.rejected)
    if row.counted == "edge":
        counted = rig.edge_counts() - before
    if row.counted == "simulator":
        rig.end_drive()  # It writes its counts at its end.
        counted = rig.simulator_counts()
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not tell.
    wrong += [*stops_between(rig.timeline.commands, begin_s, end_s), *done.wrong]
    gap_s = rig.longest_gap(begin_s, end_s)
    return replace(done, reaction_s=gap_s, rejected=dict(counted), wrong=wrong)


def report_row(row: Row, outcome: Outcome, later_s: float = 0.0) -> dict[str, Any]:
    """Return a row of the report: spreads of the times, how many were late, and what was wrong.

    For another T than 0.1 s a reaction may take ``later_s`` longer, which is the difference of 2 T,
    and a recovery that of the five states that it takes.
    """
    times: dict[str, Any] = {}
    for kind, plural, factor in (("reaction", "reactions", 1.0), ("recovery", "recoveries", 2.5)):
        limit_s = getattr(row, f"{kind}_limit_s")
        limit_s = None if limit_s is None else limit_s + factor * later_s
        found = [getattr(t, f"{kind}_s") for t in outcome.tries]
        found_s = [value_s for value_s in found if value_s is not None]
        times[f"{kind}_ms"] = spread_ms(found_s)
        times[f"{kind}_limit_ms"] = None if limit_s is None else round(limit_s * 1e3, 1)
        times[f"{plural}_late"] = sum(limit_s is not None and s > limit_s for s in found_s)
    late = times["reactions_late"] + times["recoveries_late"]
    wrong = [*outcome.failures, *(text for t in outcome.tries for text in t.wrong)]
    names = {name for t in outcome.tries for name in t.figures}
    return {
        **{name: getattr(row, name) for name in ("name", "done", "expected", "measured")},
        "tries": len(outcome.tries) + len(outcome.failures),
        "disturbed": outcome.disturbed,
        **times,
        "reasons": dict(Counter(t.reason for t in outcome.tries if t.reason)),
        "rejected": dict(sum((Counter(t.rejected) for t in outcome.tries), Counter())),
        "figures": {n: max(t.figures.get(n, -math.inf) for t in outcome.tries) for n in names},
        "wrong": wrong,
        "unsafe": outcome.unsafe,
        "crashes": outcome.crashes,
        "passed": not (late or wrong or outcome.unsafe or outcome.crashes),
    }
