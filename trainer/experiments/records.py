"""Records as tidy tables: what runs leave behind, packed files, and one row of numbers a unit.

A unit leaves a small file in its own directory under ``runs``. The tables in ``results`` are made
of these: ``pandas.read_csv("results/guidance/units.csv.xz")`` reads one.
"""

from __future__ import annotations

import lzma
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bridge.outcomes import GOAL, failed
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, read_json
from trainer import util
from trainer.environments import CONDITIONS
from trainer.experiments.plan import FULL_PATH_M, PAPER_TESTS, Line, Study, Unit
from trainer.training.metrics import LEARNED as LEVELS
from trainer.training.metrics import is_reached

KEY = ["scenario", "algorithm", "setting", "seed"]  # A unit, in every table
RECORD_FILE = "record.json"  # What a unit leaves in its directory: table -> column -> values
WRITING_PATIENCE_S = 60.0
"""Longest wait for another process to finish writing the tables."""
DIGITS = 5
SUCCESS, DISTANCE, REWARD, TIME_S = "success", "distance_m", "reward", "time_s"
LATERAL, LONGITUDINAL = "lateral_acceleration_mps2", "longitudinal_acceleration_mps2"
ARRIVED_ONLY = (TIME_S, LATERAL, LONGITUDINAL)
"""Compared over drives that reach the goal only: a car that crashes at once is quick and smooth."""
TABLES: Mapping[str, Sequence[str]] = {
    "episodes": (
        "end_step",
        "return",
        DISTANCE,
        "outcome",
        "human_steps",
        "takeovers",
        *(f"validation_{score}" for score in (SUCCESS, DISTANCE, REWARD)),
    ),
    "tests": ("condition", "drives", SUCCESS, REWARD, DISTANCE),
    "drives": ("condition", "drive", *ARRIVED_ONLY),
    "units": ("digest", "period_s", "training_s"),
}
"""Table -> columns that it has at least: a row is a training episode, with the validation at its
end if there was one; a test condition; a test drive; a unit. The last table is written last: it
says which units the others hold."""
TRAINING, ALONE = "in training", "alone"
"""A curve of the training episodes, in which the human helps (the paper's), or of the policy alone,
on validation seeds."""
SCORES = (SUCCESS, REWARD, DISTANCE)
SPENT = ("steps", "episodes", "human_steps", "human_s", "takeovers", "failures")
"""What a training, or its beginning, costs; failures are episodes that missed the goal."""
END_STEPS = 1_500  # What ended within so many steps of the last one is the end of a training
LEARNED, WELL = LEVELS
"""Success of the policy alone at which it counts as learned, and as learned well."""
Numbers = NDArray[np.float64]
Columns = Mapping[str, Sequence[Any]]
Record = Mapping[str, Columns]  # Table -> the unit's rows in it


def rounded(value: Any) -> Any:
    """Return a number with five digits; anything else as it is."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def summarise_tests(scenario: str, condition: str, drives: Columns) -> dict[str, Any]:
    """Return the row of the table of tests for the drives of one condition.

    Distances end at the goal: how far the last step goes beyond it only shows the speed.
    """
    reached = np.array([outcome == GOAL for outcome in drives["outcome"]])
    full_m = FULL_PATH_M.get(scenario, np.inf)
    distance_m = np.minimum(np.asarray(drives[DISTANCE], float), full_m)
    first = distance_m[:PAPER_TESTS]
    means = {name: np.asarray(drives[name], float)[reached].mean() for name in ARRIVED_ONLY
             if reached.any() and None not in drives[name]}  # fmt: skip
    return {
        "condition": condition,
        "drives": len(reached),
        SUCCESS: float(reached.mean()),
        REWARD: float(np.mean(drives[REWARD])),
        DISTANCE: float(distance_m.mean()),
        "paper_success": float(reached[:PAPER_TESTS].mean()),
        "paper_distance_m": float(first.mean()),
        "paper_distance_sd_m": float(first.std()),
        **{name: float(means[name]) if name in means else None for name in ARRIVED_ONLY},
    }


@dataclass(frozen=True)
class Store:
    """Where the units of a study are."""

    study: Study
    results: Path  # Directory of the tables and the page, to be committed
    runs: Path  # Directory of checkpoints, actors and new records, which is not
    humans: Path  # Directory with a human model for each scenario

    def run_dir(self, unit: Unit) -> Path:
        """Where the unit is trained, and its actor stays."""
        return self.runs / self.study.run_name(unit)

    def load(self, units: Iterable[Unit], seeds: int) -> Records:
        """Return the current records of these units, after packing those that runs have left.

        Raises UserError: a record or a table is damaged, or another process keeps writing.
        """
        wanted = {unit: self.study.digest(unit) for unit in units}
        if self._unpacked(wanted, self._tables()):
            with util.held(self.results, WRITING_PATIENCE_S) as mine:
                if not mine:
                    raise UserError(f"{self.results} is held by another process")
                tables = self._tables()
                self._pack(tables, self._unpacked(wanted, tables))
        tables = self._tables()
        known = tables["units"]["digest"].to_dict()
        found = [unit for unit, digest in wanted.items() if known.get(unit) == digest]
        stale = [unit for unit, digest in wanted.items() if known.get(unit, digest) != digest]
        current = {name: table[table.index.isin(found)] for name, table in tables.items()}
        return Records(self.study, current, found, stale, seeds)

    def record_left(self, unit: Unit) -> Record | None:
        """Return the current record that a run has left in the unit's directory."""
        path = self.run_dir(unit) / RECORD_FILE
        if not path.is_file():
            return None
        record = read_json(path, "record")
        with util.fitting(f"{path} is no record of a unit"):
            return record if record["units"]["digest"] == [self.study.digest(unit)] else None

    def _unpacked(
        self, wanted: Mapping[Unit, str], tables: Mapping[str, pd.DataFrame]
    ) -> dict[Unit, Record]:
        """Return the records that runs have left and that the tables lack."""
        known = tables["units"]["digest"].to_dict()
        missing = [unit for unit, digest in wanted.items() if known.get(unit) != digest]
        left = ((unit, self.record_left(unit)) for unit in missing)
        return {unit: record for unit, record in left if record}

    def _tables(self) -> dict[str, pd.DataFrame]:
        """Return all tables, with the unit as their index; empty where there is no file."""
        tables = {}
        for name, columns in TABLES.items():
            path, table = self._file(name), pd.DataFrame(columns=KEY)
            with util.fitting(f"{path} is no table of records, or damaged"):
                if path.is_file():
                    table = pd.read_csv(path)
                table = table.set_index(KEY)
            tables[name] = table.reindex(columns=table.columns.union(columns, sort=False))
        return tables

    def _file(self, table: str) -> Path:
        return self.results / f"{table}.csv.xz"

    def _pack(self, tables: Mapping[str, pd.DataFrame], new: Mapping[Unit, Record]) -> None:
        """Rewrite the tables with new records, each file whole or not at all."""
        for name in TABLES:
            old = tables[name][~tables[name].index.isin(list(new))]
            rows = (pd.DataFrame({**dict(zip(KEY, unit, strict=True)), **record[name]})
                    for unit, record in new.items() if name in record)  # fmt: skip
            parts = [part for part in (old.reset_index(), *rows) if len(part)]
            if parts:
                table = pd.concat(parts).sort_values(KEY, kind="stable")
                text = table.to_csv(index=False).encode()
                write_atomic(self._file(name), lzma.compress(text, preset=9))


@dataclass(frozen=True)
class Records:
    """The current records of a study."""

    study: Study
    tables: Mapping[str, pd.DataFrame]
    found: Collection[Unit]
    stale: Collection[Unit]  # Units whose record is of other settings, and left out
    seeds: int  # How many are wanted

    def of(self, scenario: str, line: Line) -> pd.DataFrame:
        """Return the numbers of a line's units, by seed; what is only tested has seed 0."""
        numbers = self.numbers
        rows = (numbers.scenario == scenario) & (numbers.algorithm == line.algorithm)
        return numbers[rows & (numbers.setting == line.setting)]

    def only(self, seeds: int) -> Records:
        """Return the records of the first seeds."""
        few = {name: table[table.index.get_level_values("seed") <= seeds]
               for name, table in self.tables.items()}  # fmt: skip
        found = [unit for unit in self.found if unit.seed <= seeds]
        return replace(self, tables=few, found=found, seeds=seeds)

    def units_of(self, scenario: str, line: Line) -> list[Unit]:
        """Return the line's units that there are, by seed."""
        return [Unit(*key) for key in self.of(scenario, line)[KEY].itertuples(index=False)]

    def arrivals(self, scenario: str, line: Line, condition: str) -> pd.DataFrame:
        """Return the test drives of a line that are kept and reach the goal."""
        drives = self.tables["drives"]
        here = drives.index.isin(self.units_of(scenario, line))
        return drives[here & (drives.condition == condition)]

    @cached_property
    def numbers(self) -> pd.DataFrame:
        """One row a unit: its columns of ``units``, its costs, and its tests by condition.

        Costs of a whole training have plain names (``human_s``); ``human_s_to_90%`` is what it
        took until the policy alone reached that level in validation, infinite where it never did.
        """
        units = self.tables["units"].sort_index()
        costs = pd.DataFrame([self._costs(Unit(*key)) for key in units.index], units.index)
        tests = self.tables["tests"].pivot_table(index=KEY, columns="condition")
        tests.columns = [f"{quantity} {condition}" for quantity, condition in tests.columns]
        numbers = pd.concat([units, costs, tests], axis=1).reset_index()
        wanted = [
            *SPENT,
            "unlearned",
            *(f"{quantity} {condition}" for quantity, condition in product(SCORES, CONDITIONS)),
            *(f"{name}_to_{level:.0%}" for name, level in product(SPENT, LEVELS)),
        ]
        return numbers.reindex(columns=numbers.columns.union(wanted, sort=False))

    def _costs(self, unit: Unit) -> dict[str, float]:
        if not unit.trained:
            return {}
        steps, success = self.points(unit, ALONE, SUCCESS)
        whole = self._spent(unit, float(self._episodes[unit].end_step.iloc[-1]))
        lost = success.max() - self.end(unit, ALONE, SUCCESS)
        row = {**whole, "unlearned": max(lost, 0.0)}  # A mean of equals may be rounded up
        for level in LEVELS:
            there = steps[[is_reached(level, each) for each in success]]
            spent = self._spent(unit, float(there[0])) if len(there) else {}
            row |= {f"{name}_to_{level:.0%}": spent.get(name, np.inf) for name in SPENT}
        return row

    def _spent(self, unit: Unit, until_step: float) -> dict[str, float]:
        """Return what the episodes up to a step cost."""
        rows = self._episodes[unit]
        rows = rows[rows.end_step <= until_step]
        human_steps, takeovers = int(rows.human_steps.sum()), int(rows.takeovers.sum())
        human_s, failures = human_steps * self._period_s[unit], sum(map(failed, rows.outcome))
        costs = (until_step, len(rows), human_steps, human_s, takeovers, failures)
        return dict(zip(SPENT, costs, strict=True))

    @cached_property
    def _episodes(self) -> dict[Unit, pd.DataFrame]:
        return {Unit(*key): rows for key, rows in self.tables["episodes"].groupby(KEY)}

    @cached_property
    def _period_s(self) -> dict[tuple[Any, ...], float]:
        return self.tables["units"].period_s.to_dict()

    def points(self, unit: Unit, kind: str, metric: str) -> tuple[Numbers, Numbers]:
        """Return at which steps a metric was measured, and its values; in training an episode."""
        rows = self._episodes[unit]
        if kind == ALONE:
            rows = rows[rows.validation_success.notna()]
            return rows.end_step.to_numpy(float), rows[f"validation_{metric}"].to_numpy(float)
        if metric == SUCCESS:
            values = (rows.outcome == GOAL).to_numpy(float)
        else:
            values = rows["return" if metric == REWARD else metric].to_numpy(float)
        if metric == DISTANCE:
            values = np.minimum(values, FULL_PATH_M.get(unit.scenario, np.inf))
        return rows.end_step.to_numpy(float), values

    def grid(self, scenario: str) -> Numbers:
        """Return the steps of a curve's points: multiples of the validations' distance."""
        every = self.study.of(scenario).evaluate_every_steps
        return np.arange(every, self.study.steps[scenario] + 1, every, dtype=float)

    def curve(self, unit: Unit, kind: str, metric: str, grid: Numbers) -> Numbers:
        """Return a metric at each point of a grid.

        In training it is the mean of the episodes since the point before, or of the next one
        where none ended there.
        """
        steps, values = self.points(unit, kind, metric)
        if kind == ALONE:
            return np.interp(grid, steps, values)
        means = []
        for end in grid:
            inside = (steps > end - grid[0]) & (steps <= end)
            next_one = min(int(np.searchsorted(steps, end)), len(values) - 1)
            means.append(values[inside].mean() if inside.any() else values[next_one])
        return np.array(means)

    def human_s(self, unit: Unit, grid: Numbers) -> Numbers:
        """Return the seconds that the human had driven at each point of a grid."""
        return np.array([self._spent(unit, step)["human_s"] for step in grid])

    def end(self, unit: Unit, kind: str, metric: str) -> float:
        """Return the mean of what was measured in the last ``END_STEPS`` steps."""
        steps, values = self.points(unit, kind, metric)
        return float(values[steps > steps[-1] - END_STEPS].mean())
