"""The records of the units, and where everything of a unit is kept.

The record of a unit, one JSON object, is a line of ``results/paper/<scenario>.jsonl``. Its
checkpoint and its actor lie in a directory of its own under ``runs``, which is not committed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError, read_bytes
from trainer.drivers import CHECKPOINT_FILE
from trainer.experiments.plan import (
    SCENARIOS,
    Plan,
    Unit,
    obstacle,
    training_id,
    unit_id,
    units_of,
)
from trainer.training.metrics import METRICS_FILE
from trainer.util import held

TRAINING_COLUMNS = {
    "end_step": "total_steps",
    "return": "episode_return",
    "distance_m": "distance_m",
    "outcome": "outcome",
    "human_steps": "human_steps",
    "takeovers": "interventions",
}
"""Column of a record -> column of a run's metrics, a value an episode."""
VALIDATION_COLUMNS = {
    "at_step": "total_steps",
    "success": "validation_success",
    "distance_m": "validation_distance_m",
    "reward": "validation_reward",
}
"""The same, a value a validation."""
TEST_COLUMNS = (
    "outcome",
    "distance_m",
    "time_s",
    "reward",
    "lateral_acceleration_mps2",
    "longitudinal_acceleration_mps2",
)
"""What is kept of each test drive; the seeds are 0, 1, ..."""
FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; at a checkpoint, for lack of time; at once, since
another process has it; with an error."""
DONE, STALE, RUNNING, BEGUN, MISSING, IMPOSSIBLE = (
    "done",
    "of other settings",
    "running",
    "begun",
    "missing",
    "without its human",
)
"""What a unit can be."""
WRITING_PATIENCE_S = 60.0
"""How long one waits for a file of records, into which another process writes a megabyte."""


@dataclass(frozen=True)
class Store:
    """Where the units of a plan are."""

    plan: Plan
    """What they have in common."""
    results: Path
    """Directory of the records, to be committed."""
    runs: Path
    """Directory of checkpoints and actors, which is not."""
    humans: Path
    """Directory with a human model for each scenario."""

    def id(self, unit: Unit) -> str:
        """The id of the unit's record."""
        return unit_id(unit, self.plan, self.humans)

    def records_file(self, scenario: str) -> Path:
        """The records of a scenario, a line each."""
        return self.results / f"{scenario}.jsonl"

    def run_dir(self, unit: Unit) -> Path:
        """Where the unit is trained; its actor stays there."""
        return self.runs / f"{'-'.join(map(str, unit))}-{training_id(unit, self.plan, self.humans)}"

    def lock_file(self, unit: Unit) -> Path:
        """Beside the unit's directory."""
        run_dir = self.run_dir(unit)
        return run_dir.with_name(f"{run_dir.name}.lock")

    @contextmanager
    def lock(self, unit: Unit, patience_s: float = 0.0) -> Iterator[bool]:
        """Hold a unit against other processes; gives whether that was possible."""
        make_directory(self.runs)
        with held(self.lock_file(unit), patience_s) as mine:
            yield mine

    def records(self, scenario: str) -> dict[Unit, dict[str, Any]]:
        """All records of a scenario, current or not; none where there is no file.

        Raises:
            UserError: a line is not what ``put`` writes.
        """
        path, found = self.records_file(scenario), {}
        text = read_bytes(path, "records").decode(errors="replace") if path.exists() else ""
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                record = json.loads(line)
                if not isinstance(record["id"], str) or not isinstance(record["tests"], dict):
                    raise TypeError("no record")
                found[Unit(**record["unit"])] = record
            except (ValueError, KeyError, TypeError) as error:
                raise UserError(f"{path}, line {number}, is no record of a unit: {error}") from None
        return found

    def record(self, unit: Unit) -> dict[str, Any] | None:
        """A unit's record, where there is one and it is of the same settings."""
        record = self.records(unit.scenario).get(unit)
        return record if record and record["id"] == self.id(unit) else None

    def put(self, unit: Unit, record: dict[str, Any]) -> None:
        """Add a record, in place of an older one of the unit: whole or not at all."""
        path = self.records_file(unit.scenario)
        make_directory(path.parent)
        with held(path.with_name(f".{path.name}.lock"), WRITING_PATIENCE_S) as mine:
            if not mine:
                raise UserError(f"{path} is held by another process")
            records = {**self.records(unit.scenario), unit: record}
            lines = [
                json.dumps(records[each], separators=(",", ":"), allow_nan=False) + "\n"
                for each in sorted(records)
            ]
            write_atomic(path, "".join(lines).encode())

    def keep(self, unit: Unit, record: dict[str, Any] | None) -> str:
        """Put what work on a unit came to, and tidy up; how it ended."""
        if record is None:
            return STOPPED
        self.put(unit, record)
        # The actor stays, for export and for tests to come; what learning needs is large.
        (self.run_dir(unit) / CHECKPOINT_FILE).unlink(missing_ok=True)
        return FINISHED

    def states(self, units: Sequence[Unit]) -> dict[Unit, str]:
        """The state of each unit: done, of other settings, running, begun, missing, ..."""
        records = {scenario: self.records(scenario) for scenario in SCENARIOS}
        return {unit: self._state(unit, records[unit.scenario].get(unit)) for unit in units}

    def _state(self, unit: Unit, record: dict[str, Any] | None) -> str:
        if obstacle(unit, self.humans):
            return IMPOSSIBLE
        if record and record["id"] == self.id(unit):
            return DONE
        if self.lock_file(unit).exists():
            with self.lock(unit) as free:
                if not free:
                    return RUNNING
        if (self.run_dir(unit) / METRICS_FILE).exists():
            return BEGUN
        return STALE if record else MISSING

    def status_lines(self, seeds_wanted: int) -> Iterator[str]:
        """A line for each algorithm and setting: how many of its units are in which state."""
        states = self.states(units_of(["all"], seeds_wanted))
        groups: dict[tuple[str, ...], Counter[str]] = {}
        for unit, state in states.items():
            line = (unit.setting, unit.algorithm, unit.scenario)
            groups.setdefault(line, Counter())[state] += 1
        for (setting, algorithm, scenario), counts in groups.items():
            said = ", ".join(f"{count} {state}" for state, count in counts.items())
            yield f"{setting:10} {algorithm:24} {scenario:11} {said}"
        yield f"{list(states.values()).count(DONE)} of {len(states)} units done"
