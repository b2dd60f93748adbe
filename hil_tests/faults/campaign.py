"""Runs rows of the fault table, several rigs at once, and gathers what each try gave."""

from __future__ import annotations

import contextlib
import fnmatch
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.slow_policy import write_full, write_mean, write_slow, write_steady
from hil_tests.faults.table import ROWS
from hil_tests.faults.timeline import longest_gap_s, spread_ms, unsafe_commands
from hil_tests.options import trusting

POLICY = Path("results/policies/left_turn.onnx")
PUBLIC_KEY = POLICY.with_name("policy.pub")
STALLED_S = 1.5 * CONTROL_PERIOD_S
"""States further apart than this are not the real-time drive that a row is about."""
MOST_DISTURBED = 100
OnProgress = Callable[[str, int, int], None]
"""Told the row, and how many of all tries are done."""


@dataclass
class Outcome:
    """What all tries of a row gave."""

    tries: list[Try] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    disturbed: int = 0
    """Tries in which the machine itself stood still, done again."""
    failures: list[str] = field(default_factory=list)
    """Tries that came to no end: nothing was seen of what should have come."""


def run_faults(
    tries: int,
    rows: Sequence[str] | None = None,
    policy: Path | None = None,
    on_progress: OnProgress = lambda row, done, total: None,
    jobs: int = 2,
    public_key: str | None = None,
) -> dict[str, Any]:
    """Do every row ``tries`` times (fewer where the row says so); a report for JSON.

    Args:
        tries: of each row.
        rows: names of the table's rows, or patterns of them (``hunter_*``); None for all.
        policy: an exported policy; None for the repository's own left turn.
        on_progress: called after every try.
        jobs: rigs at once; rows that need the machine for themselves run after the others.
        public_key: what the policy is verified with.

    Raises:
        UserError: a row that the table does not hold, or no policy.
    """
    chosen = _choose(rows)
    with tempfile.TemporaryDirectory(prefix="phil-faults-") as work:
        trust = _trusted(policy, public_key)
        campaign = _Campaign(Path(work), trust, tries, chosen, on_progress)
        with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
            futures = {row.name: pool.submit(campaign.run, row) for row in chosen if not row.alone}
            outcomes = {name: future.result() for name, future in futures.items()}
        outcomes |= {row.name: campaign.run(row) for row in chosen if row.alone}
    found = [_report_row(row, outcomes[row.name]) for row in chosen]
    return {
        "tries": tries,
        "rows": found,
        "crashes": sum(len(row["crashes"]) for row in found),
        "unsafe_commands": sum(len(row["unsafe"]) for row in found),
        "passed": all(row["passed"] for row in found),
    }


class _Campaign:
    def __init__(
        self,
        work: Path,
        trust: Sequence[str],
        tries: int,
        rows: Sequence[Row],
        on_progress: OnProgress,
    ) -> None:
        self._work, self._tries, self._on_progress = work, tries, on_progress
        self._done, self._total = 0, sum(self._tries_of(row) for row in rows)
        self._lock = threading.Lock()
        self._policies = {"given": trust}
        makers = {
            "slow": write_slow, "steady": write_steady, "full": write_full, "mean": write_mean,
        }  # fmt: skip
        for kind in {row.policy for row in rows} & set(makers):
            path = work / f"{kind}.onnx"
            makers[kind](path)
            self._policies[kind] = trusting(path, None)

    def run(self, row: Row) -> Outcome:
        """All tries of a row; a rig in which a try came to no end is replaced."""
        outcome, number, tries = Outcome(), 0, self._tries_of(row)
        while number < tries:
            with self._rig(row, outcome) as rig:
                going = True
                while going and number < tries:
                    kept = outcome.disturbed
                    going = self._try(row, rig, number, outcome) and not row.new_rig_each_try
                    if outcome.disturbed == kept:
                        number += 1
                        self._tick(row)
                _judge(row, rig, outcome)
        return outcome

    def _try(self, row: Row, rig: Rig, number: int, outcome: Outcome) -> bool:
        try:
            rig.wait_until_driving()
            begin_s = rig.mark()
            done = row.run(rig, number)
            gap_s = longest_gap_s(list(rig.timeline.flow_s), begin_s, rig.mark())
            again = row.flows and gap_s > STALLED_S and outcome.disturbed < MOST_DISTURBED
            if again:
                outcome.disturbed += 1
            else:
                outcome.tries.append(done)
        except TimeoutError as error:
            outcome.failures.append(f"try {number}: {error}")
            return False
        return True

    @contextlib.contextmanager
    def _rig(self, row: Row, outcome: Outcome) -> Any:
        directory = Path(tempfile.mkdtemp(dir=self._work))
        rig = Rig(self._policies[row.policy], directory, **row.rig)
        try:
            yield rig
        finally:
            rig.close()
            outcome.crashes += rig.crashes

    def _tries_of(self, row: Row) -> int:
        return self._tries if row.most_tries is None else min(self._tries, row.most_tries)

    def _tick(self, row: Row) -> None:
        with self._lock:
            self._done += 1
            self._on_progress(row.name, self._done, self._total)


def _judge(row: Row, rig: Rig, outcome: Outcome) -> None:
    timeline = rig.timeline
    outcome.unsafe += unsafe_commands(timeline.commands, timeline.states, by_arrival=row.by_arrival)
    if timeline.unreadable:
        outcome.unsafe.append(f"{timeline.unreadable} commands that nobody would take")


def check_rows(names: Sequence[str]) -> None:
    """Raise UserError for a name that the table does not hold, or a pattern that fits none."""
    known = [row.name for row in ROWS]
    for name in names:
        if not fnmatch.filter(known, name):
            raise UserError(f"no fault {name!r}; choose from {', '.join(known)}")


def _choose(names: Sequence[str] | None) -> list[Row]:
    if names is None:
        return list(ROWS)
    check_rows(names)
    return [row for row in ROWS if any(fnmatch.fnmatch(row.name, name) for name in names)]


def _trusted(policy: Path | None, public_key: str | None) -> tuple[str, ...]:
    if policy is None:
        return ("--policy", str(POLICY), "--public-key", public_key or str(PUBLIC_KEY))
    return trusting(policy, public_key)


def _report_row(row: Row, outcome: Outcome) -> dict[str, Any]:
    reactions = [t.reaction_s for t in outcome.tries if t.reaction_s is not None]
    recoveries = [t.recovery_s for t in outcome.tries if t.recovery_s is not None]
    late = _over(reactions, row.reaction_limit_s), _over(recoveries, row.recovery_limit_s)
    wrong = [*outcome.failures, *(text for t in outcome.tries for text in t.wrong)]
    rejected: Counter[str] = Counter()
    figures: dict[str, list[float]] = {}
    for one in outcome.tries:
        rejected.update(one.rejected)
        for name, value in one.figures.items():
            figures.setdefault(name, []).append(value)
    return {
        "name": row.name,
        "done": row.done,
        "expected": row.expected,
        "measured": row.measured,
        "tries": len(outcome.tries) + len(outcome.failures),
        "disturbed": outcome.disturbed,
        "reaction_ms": spread_ms(reactions),
        "reaction_limit_ms": _ms(row.reaction_limit_s),
        "reactions_late": late[0],
        "recovery_ms": spread_ms(recoveries),
        "recovery_limit_ms": _ms(row.recovery_limit_s),
        "recoveries_late": late[1],
        "reasons": dict(Counter(t.reason for t in outcome.tries if t.reason)),
        "rejected": dict(rejected),
        "figures": {name: max(values) for name, values in figures.items()},
        "notes": [text for t in outcome.tries for text in t.notes],
        "wrong": wrong,
        "unsafe": outcome.unsafe,
        "crashes": outcome.crashes,
        "passed": not (any(late) or wrong or outcome.unsafe or outcome.crashes),
    }


def _over(values_s: Sequence[float], limit_s: float | None) -> int:
    return 0 if limit_s is None else sum(value_s > limit_s for value_s in values_s)


def _ms(limit_s: float | None) -> float | None:
    return None if limit_s is None else round(limit_s * 1e3, 1)
