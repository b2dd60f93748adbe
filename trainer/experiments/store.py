"""Where units live: a working directory while they are computed, a small result when they are.

``runs/units/<unit>/`` holds checkpoint and actor and is not committed; ``results/units/...`` holds
what the figures need and is. A result appears there in one rename, whole.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from edge_runtime.errors import UserError
from edge_runtime.files import make_directory, write_atomic
from trainer.conditions import CONDITIONS
from trainer.experiments.plan import Plan
from trainer.experiments.units import Unit, obstacle, unit_id
from trainer.locks import held, holder
from trainer.training.metrics import METRICS_FILE

UNIT_FILE = "config.json"
TESTS_FILE = "tests.json"
RESULT_FILES = (UNIT_FILE, METRICS_FILE, TESTS_FILE)
LATER = {"dense"}
"""Conditions that the first results lack. They stay valid without them; new results have them."""
DONE, RUNNING, BEGUN, MISSING, IMPOSSIBLE = (
    "done",
    "running",
    "begun",
    "missing",
    "impossible",
)
"""What a unit can be: computed; being computed by a living process; stopped or killed with a
checkpoint; not begun; not possible in this version."""


@dataclass(frozen=True)
class Store:
    """Units of one plan.

    Args:
        plan: what every run has in common; another plan gives other ids.
        results: directory that is committed.
        runs: directory that is not.
        humans: directory with a human model for each scenario.
    """

    plan: Plan
    results: Path
    runs: Path
    humans: Path

    def id(self, unit: Unit) -> str:
        """Of what decides the unit's result."""
        return unit_id(unit, self.plan, self.humans)

    def result_dir(self, unit: Unit) -> Path:
        """Where the unit's result is, or will be."""
        place = self.results / "units" / unit.scenario / unit.algorithm / unit.setting
        return place / f"seed_{unit.seed}-{self.id(unit)}"

    def run_dir(self, unit: Unit) -> Path:
        """The unit's working directory."""
        name = f"{unit.scenario}-{unit.algorithm}-{unit.setting}-{unit.seed}-{self.id(unit)}"
        return self.runs / "units" / name

    def done(self, unit: Unit) -> bool:
        """Whether the result is there, with tests in every condition but those that came later."""
        path = self.result_dir(unit) / TESTS_FILE
        try:
            tests = json.loads(path.read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            return False
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(f"{path} is broken: {error}") from error
        if not isinstance(tests, dict):
            raise UserError(f"{path} is broken: it names no conditions")
        return set(CONDITIONS) - LATER <= set(tests)

    def state(self, unit: Unit) -> str:
        """One of done, running, begun, missing, impossible."""
        if obstacle(unit, self.humans):
            return IMPOSSIBLE
        if self.done(unit):
            return DONE
        run_dir = self.run_dir(unit)
        # On Ray the working directory is elsewhere, and only the lock is here.
        if not (run_dir.is_dir() or self.lock_file(unit).is_file()):
            return MISSING
        with self.lock(unit) as free:
            if not free:
                return RUNNING
        return BEGUN if (run_dir / METRICS_FILE).is_file() else MISSING

    def put(self, unit: Unit, files: Mapping[str, bytes]) -> None:
        """Store a result: it is there whole, or not at all, whenever the process is killed."""
        target = self.result_dir(unit)
        make_directory(target.parent)
        _sweep(target.parent)
        fresh = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=target.parent))
        for name in RESULT_FILES:
            if name in files:
                write_atomic(fresh / name, files[name])
        fresh.chmod(0o755)
        if target.exists():  # without a condition that came later
            target.rename(Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=target.parent)) / "old")
        fresh.rename(target)
        _sweep(target.parent)

    @contextmanager
    def lock(self, unit: Unit, patience_s: float = 0.0) -> Iterator[bool]:
        """Hold the unit against other processes; gives whether that was possible.

        Whoever wants to work is patient for a moment: ``state`` takes the lock, too, to see whether
        it can be had.
        """
        path = self.lock_file(unit)
        make_directory(path.parent)
        with held(path, patience_s) as free:
            yield free

    def lock_file(self, unit: Unit) -> Path:
        """Beside the working directory."""
        run_dir = self.run_dir(unit)
        return run_dir.with_name(f"{run_dir.name}.lock")

    def holder(self, unit: Unit) -> str:
        """Who holds the unit's lock, in words."""
        return holder(self.lock_file(unit))


_TEMPORARY = ".unfinished-"
_ABANDONED_S = 600.0
"""A result is a few small files, written in far less."""


def _sweep(directory: Path) -> None:
    """Remove what a killed ``put`` left; nobody reads it. Another process's own is left alone."""
    for path in directory.glob(f"{_TEMPORARY}*"):
        if path.is_dir() and _abandoned(path):
            shutil.rmtree(path, ignore_errors=True)


def _abandoned(path: Path) -> bool:
    try:
        return (path / "old").exists() or time.time() - path.stat().st_mtime > _ABANDONED_S
    except FileNotFoundError:
        return False
