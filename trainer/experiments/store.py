"""The records of the units, and where everything of a unit is kept.

The record of a unit, one JSON object, is a line of ``results/paper/<scenario>.jsonl``. Its
checkpoint and its actor lie in a directory of its own under ``runs``, which is not committed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
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
from trainer.util import held

FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; at a checkpoint, for lack of time; at once, since
another process has it; with an error."""
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

    def find(self, units: Iterable[Unit]) -> tuple[dict[Unit, dict[str, Any]], list[Unit]]:
        """The records of these units, and those units whose record is of other settings."""
        records = {scenario: self.records(scenario) for scenario in SCENARIOS}
        found, stale = {}, []
        for unit in units:
            record = records[unit.scenario].get(unit)
            if record is None:
                continue
            if obstacle(unit, self.humans) or record["id"] != self.id(unit):
                stale.append(unit)
            else:
                found[unit] = record
        return found, stale

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

    def status_lines(self, seeds: int) -> Iterator[str]:
        """A line for each algorithm and setting: how many of its units are done."""
        units = units_of(["all"], seeds)
        found, stale = self.find(units)
        done = Counter(unit[:3] for unit in found)
        for line, count in Counter(unit[:3] for unit in units).items():
            scenario, algorithm, setting = line
            yield f"{setting:10} {algorithm:24} {scenario:11} {done[line]} of {count} done"
        yield f"{len(found)} of {len(units)} units done; {len(stale)} records of other settings"
