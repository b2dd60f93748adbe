"""Runs rows of the fault table, several rigs at once, and gathers what each try gave."""

from __future__ import annotations

import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge_runtime.manifest import Task
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests.faults import hunter, messages  # noqa: F401 (they fill the table)
from hil_tests.faults.observe import later_s, longest_gap_s, spread_ms, unsafe_commands
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import Row, Try, at_any_phase, do_fault
from hil_tests.processes import POLICY, in_parallel, trusting
from hil_tests.testing.policies import TASK, write_policy

STALLED_PERIODS = 1.5
"""States further apart than this are not the real-time drive that a row is about."""
MOST_DISTURBED = 100


POLICIES: dict[str, Callable[[Path], object]] = {
    "steady": lambda path: write_policy(path, "constant", 0.6),
    "full": lambda path: write_policy(path, "constant", 1.0),
    # Brightness is its pedal: full throttle on white frames, the brake on all others.
    "mean": lambda path: write_policy(path, "mean"),
}
"""Made for the rows that name them."""


@dataclass
class Outcome:
    """What all tries of a row gave."""

    tries: list[Try] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    disturbed: int = 0  # Tries in which the machine itself stood still, done again
    failures: list[str] = field(default_factory=list)
    """Tries that came to no end: nothing was seen of what should have come."""


def run_faults(
    chosen: Sequence[Row],
    tries: int,
    policy: Path = POLICY,
    on_try: Callable[[str], None] = lambda row: None,
    jobs: int = 2,
    public_key: str | None = None,
) -> dict[str, Any]:
    """Do every row ``tries`` times; a report for JSON.

    An exported ``policy`` is verified with ``public_key``. ``on_try`` is called with the row's name
    after every try. ``jobs`` rigs run at once; rows that need the machine for themselves run after
    the others. Raises UserError where there is no policy.
    """
    trust = trusting(policy, public_key)
    given = load_policy(policy, public_key, allow_unsigned=True).manifest
    with tempfile.TemporaryDirectory(prefix="phil-faults-") as folder:
        work = Path(folder)
        policies = {"given": trust}
        for kind in {row.policy for row in chosen} & set(POLICIES):
            path = work / f"{kind}.onnx"
            POLICIES[kind](path)
            policies[kind] = trusting(path, None)
        outcomes: dict[str, Outcome] = {}
        ended = threading.Event()
        for alone in (False, True):
            in_parallel(
                lambda row: run_row(
                    row, policies[row.policy], task_of(row, given), work, tries, on_try, ended
                ),
                [row for row in chosen if row.alone == alone],
                1 if alone else jobs,
                lambda row, outcome: outcomes.update({row.name: outcome}),
                ended,
            )
    found = [report_row(row, outcomes[row.name], later_s(task_of(row, given))) for row in chosen]
    return {
        "tries": tries,
        "rows": found,
        "crashes": sum(len(row["crashes"]) for row in found),
        "unsafe_commands": sum(len(row["unsafe"]) for row in found),
        "passed": all(row["passed"] for row in found),
    }


def task_of(row: Row, given: Task) -> Task:
    """What the row's policy is made for: only ``given`` ones may differ from `TASK`."""
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
    """All tries of a row, each rig in a directory in ``work``; one that hangs is replaced.

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
    """Whether the rig can be used again."""
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


def report_row(row: Row, outcome: Outcome, later_s: float = 0.0) -> dict[str, Any]:
    """A row of the report: spreads of the times, how many were late, and what was wrong.

    For another T than 0.1 s a reaction may take ``later_s`` longer, which is the difference of 2 T,
    and a recovery that of the five states that it takes.
    """
    limit_s = None if row.reaction_limit_s is None else row.reaction_limit_s + later_s
    recovery_limit_s = row.recovery_limit_s
    if recovery_limit_s is not None:
        recovery_limit_s += 2.5 * later_s
    reactions = [t.reaction_s for t in outcome.tries if t.reaction_s is not None]
    recoveries = [t.recovery_s for t in outcome.tries if t.recovery_s is not None]
    late = _over(reactions, limit_s), _over(recoveries, recovery_limit_s)
    wrong = [*outcome.failures, *(text for t in outcome.tries for text in t.wrong)]
    names = {name for t in outcome.tries for name in t.figures}
    figures = {n: max(t.figures[n] for t in outcome.tries if n in t.figures) for n in names}
    return {
        **{name: getattr(row, name) for name in ("name", "done", "expected", "measured")},
        "tries": len(outcome.tries) + len(outcome.failures),
        "disturbed": outcome.disturbed,
        "reaction_ms": spread_ms(reactions),
        "reaction_limit_ms": _ms(limit_s),
        "reactions_late": late[0],
        "recovery_ms": spread_ms(recoveries),
        "recovery_limit_ms": _ms(recovery_limit_s),
        "recoveries_late": late[1],
        "reasons": dict(Counter(t.reason for t in outcome.tries if t.reason)),
        "rejected": dict(sum((Counter(t.rejected) for t in outcome.tries), Counter())),
        "figures": figures,
        "wrong": wrong,
        "unsafe": outcome.unsafe,
        "crashes": outcome.crashes,
        "passed": not (any(late) or wrong or outcome.unsafe or outcome.crashes),
    }


def _over(values_s: Sequence[float], limit_s: float | None) -> int:
    return 0 if limit_s is None else sum(value_s > limit_s for value_s in values_s)


def _ms(limit_s: float | None) -> float | None:
    return None if limit_s is None else round(limit_s * 1e3, 1)
