"""Run rows of the fault table, several rigs at once, and report the tries."""

from __future__ import annotations

import math
import statistics
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests.faults import bounds, hunter, messages, rows
from hil_tests.faults.observe import later_s, longest_gap_s
from hil_tests.faults.policies import POLICIES, TASK, write_policy
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import Row, Try, at_any_phase
from hil_tests.processes import POLICY

STALLED_PERIODS = 1.5
"""States further apart than this are no real-time drive: the machine has stalled."""
MOST_DISTURBED = 100
ROWS = [*rows.ROWS, *hunter.ROWS, *messages.ROWS, *bounds.ROWS]


@dataclass
class Outcome:
    tries: list[Try] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    disturbed: int = 0  # Tries in which the machine stalled, and which were repeated


def run_faults(
    chosen: Sequence[Row],
    tries: int,
    policy: Path = POLICY,
    on_try: Callable[[str], None] = lambda row: None,
    jobs: int = 2,
    public_key: str | None = None,
) -> dict[str, Any]:
    """Do every row ``tries`` times, ``jobs`` rigs at once; return a report for JSON.

    ``on_try`` is called with the row's name after every try. UserError: the policy does not load.
    """
    manifest = load_policy(policy, public_key, allow_unsigned=True).manifest
    ended = threading.Event()  # No more tries begin
    with tempfile.TemporaryDirectory(prefix="phil-faults-") as folder:
        paths = {"given": policy, **{kind: write_policy(Path(folder), kind) for kind in POLICIES}}
        policies = {kind: ["--policy", str(paths[kind]), "--allow-unsigned"] for kind in paths}
        policies["given"] += ["--public-key", public_key] if public_key else []

        def do(row: Row) -> dict[str, Any]:
            task, outcome = manifest if row.policy == "given" else TASK, Outcome()

            def is_left() -> bool:
                return len(outcome.tries) < tries and not ended.is_set()

            while is_left():
                place = Path(tempfile.mkdtemp(dir=folder))
                try:
                    rig = Rig(policies[row.policy], place, task, **row.rig)
                except (OSError, UserError) as error:  # for example without multicast
                    outcome.tries.append(Try(wrong=[str(error)]))
                    break
                use_rig(row, rig, outcome, is_left, on_try)
            return report_row(row, outcome, later_s(task))

        by_name: dict[str, dict[str, Any]] = {}
        for alone in (False, True):
            part = [row for row in chosen if row.alone == alone]
            with ThreadPoolExecutor(1 if alone else jobs) as pool:
                try:
                    by_name.update(zip((row.name for row in part), pool.map(do, part), strict=True))
                except BaseException:  # ^C, too
                    ended.set()
                    raise
    reports = [by_name[row.name] for row in chosen]
    return {
        "tries": tries,
        "rows": reports,
        "crashes": sum(len(row["crashes"]) for row in reports),
        "unsafe_commands": sum(len(row["unsafe"]) for row in reports),
        "passed": all(row["passed"] for row in reports),
    }


def use_rig(
    row: Row, rig: Rig, outcome: Outcome, is_left: Callable[[], bool], on_try: Callable[[str], None]
) -> None:
    """Do tries of a row with a rig while one is left, until the rig hangs or is used up."""
    with rig:
        usable = True
        while usable and is_left():
            rig.number, begin_s = len(outcome.tries), time.monotonic()
            try:
                rig.wait_until_driving()
                at_any_phase(rig)
                begin_s = time.monotonic()
                done, usable = do_fault(row, rig), row.counted != "simulator"
            except (OSError, UserError) as error:  # a time-out, or a process that has ended
                done, usable = Try(wrong=[f"try {rig.number}: {error}"]), False
            gap_s = longest_gap_s(list(rig.timeline.flow_s), begin_s, time.monotonic())
            stalled = row.flows and gap_s > STALLED_PERIODS * rig.period_s
            if stalled and usable and outcome.disturbed < MOST_DISTURBED:
                outcome.disturbed += 1
                continue
            outcome.tries.append(done)
            on_try(row.name)
        outcome.unsafe += rig.timeline.unsafe_commands(rig.task)
    outcome.crashes += rig.crashes


def do_fault(row: Row, rig: Rig) -> Try:
    """Do the fault of a row once; if the drive must go on, judge that, too."""
    before = rig.edge_counts() if row.counted == "edge" else Counter()
    begin_s = time.monotonic()
    done = row.run(rig)
    if not row.goes_on:
        return done
    end_s = time.monotonic()
    wanted = counted = Counter(done.rejected)
    if row.counted == "edge":
        counted = rig.edge_counts() - before
    if row.counted == "simulator":
        counted = rig.end_counts()
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not show them.
    wrong += [*rig.timeline.stops_between(begin_s, end_s), *done.wrong]
    gap_s = rig.timeline.longest_gap_s(begin_s, end_s)
    return replace(done, reaction_s=gap_s, rejected=dict(counted), wrong=wrong)


def report_row(row: Row, outcome: Outcome, later_s: float = 0.0) -> dict[str, Any]:
    """Return a row of the report: spreads of the times, counts of late tries, and deviations.

    ``later_s``: by how much 2 T exceeds 0.2 s; a recovery takes five states, 2.5 times as much.
    """
    report: dict[str, Any] = {"name": row.name, "done": row.done, "expected": row.expected}
    report |= {"tries": len(outcome.tries), "disturbed": outcome.disturbed}
    late = 0
    for kind, limit_s, more_s in (
        ("reaction", row.reaction_limit_s, later_s),
        ("recovery", row.recovery_limit_s, 2.5 * later_s),
    ):
        most_ms = math.inf if limit_s is None else round((limit_s + more_s) * 1e3, 1)
        times_s = [getattr(each, f"{kind}_s") for each in outcome.tries]
        times_ms = [round(time_s * 1e3, 1) for time_s in times_s if time_s is not None]
        figures: dict[str, Any] = {"min": min, "median": statistics.median, "max": max}
        report[f"{kind}_ms"] = {name: of(times_ms) for name, of in figures.items() if times_ms}
        report[f"{kind}_limit_ms"] = None if limit_s is None else most_ms
        report[f"{kind}_late"] = sum(time_ms > most_ms for time_ms in times_ms)
        late += report[f"{kind}_late"]
    wrong = [text for each in outcome.tries for text in each.wrong]
    return {
        **report,
        "reasons": dict(Counter(each.reason for each in outcome.tries if each.reason)),
        "rejected": dict(sum((Counter(each.rejected) for each in outcome.tries), Counter())),
        "wrong": wrong,
        "unsafe": outcome.unsafe,
        "crashes": outcome.crashes,
        "passed": not (late or wrong or outcome.unsafe or outcome.crashes),
    }
