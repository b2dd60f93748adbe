"""Records of units as tidy tables: a file per unit, packed tables, and one row of numbers a unit.

A unit leaves a small file in its directory under ``runs``. They are packed into the tables in
``results``: ``pandas.read_csv("results/guidance/units.csv.xz")`` reads one.
"""

from __future__ import annotations

import lzma
from collections.abc import Collection, Mapping
from dataclasses import dataclass
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
from trainer.experiments import FULL_PATH_M, PAPER_TESTS, Line, Study, Unit
from trainer.training.metrics import LEARNED as LEVELS
from trainer.training.metrics import is_reached

KEY = ["scenario", "algorithm", "setting", "seed"]  # A unit, in every table
RECORD_FILE = "record.json"  # A unit's file in its directory: table -> column -> values
WRITING_PATIENCE_S = 60.0
"""Longest wait for another process to finish writing the tables."""
SUCCESS, DISTANCE, REWARD = "success", "distance_m", "reward"
ARRIVED_ONLY = ["time_s", "lateral_acceleration_mps2", "longitudinal_acceleration_mps2"]
"""Means of the drives that reach the goal only: a car that crashes at once is quick and smooth."""
DRIVEN = ["outcome", DISTANCE, REWARD, *ARRIVED_ONLY]  # Columns taken from a test drive
SCORES = (SUCCESS, REWARD, DISTANCE)
TABLES: Mapping[str, list[str]] = {
    "episodes": [
        *("end_step", "return", DISTANCE, "outcome", "human_steps", "takeovers"),
        *(f"validation_{score}" for score in (SUCCESS, DISTANCE, REWARD)),
    ],
    "tests": ["condition", "drives", *SCORES],
    "units": ["digest", "period_s", "training_s"],
}
"""Table -> columns that it must have. A row is a training episode, with the validation at its end
if there was one; a test condition; a unit. The table of units is written last: it lists the units
that the others hold."""
TRAINING, ALONE = "in training", "alone"
"""A curve of the training episodes, in which the human helps (the paper's), or of the policy alone,
on validation seeds."""
SPENT = ["steps", "episodes", "human_steps", "human_s", "takeovers", "failures"]
"""Costs of a training or its beginning; failures are episodes that missed the goal."""
END_STEPS = 1_500  # Last steps of a training that count as its end
LEARNED, WELL = LEVELS
"""Success of the policy alone at which it counts as learned, and as learned well."""
Numbers = NDArray[np.float64]
Record = Mapping[str, Mapping[str, list[Any]]]  # Table -> column -> the unit's values in it


def columns_of(table: pd.DataFrame) -> dict[str, list[Any]]:
    """Return the columns as JSON takes them: with None for NaN."""
    plain = table.astype(object).where(table.notna(), None)
    return {str(name): values for name, values in plain.to_dict("list").items()}


def summarise_tests(scenario: str, drives: pd.DataFrame) -> pd.DataFrame:
    """Return the table of tests, a row for each condition.

    Distances are cut at the goal: the last step's overshoot only shows the speed.
    """
    reached = drives.outcome == GOAL
    distance_m = drives[DISTANCE].clip(upper=FULL_PATH_M.get(scenario, np.inf))
    drives = drives.assign(**{SUCCESS: reached.astype(float), DISTANCE: distance_m})

    def row(of: pd.DataFrame) -> dict[str, Any]:
        first = of[:PAPER_TESTS]
        return {
            "condition": of.condition.iloc[0],
            "drives": len(of),
            **of[[*SCORES]].mean(),
            "paper_success": first[SUCCESS].mean(),
            "paper_distance_m": first[DISTANCE].mean(),
            "paper_distance_sd_m": first[DISTANCE].std(ddof=0),
            **of.loc[of.outcome == GOAL, ARRIVED_ONLY].astype(float).mean(skipna=False),
        }

    return pd.DataFrame([row(of) for _, of in drives.groupby("condition", sort=False)])


@dataclass(frozen=True)
class Store:
    study: Study
    results: Path  # Directory of the tables and the page, to be committed
    runs: Path  # Directory of checkpoints, actors and new records, which is not
    humans: Path  # Directory with a human model for each scenario

    def run_dir(self, unit: Unit) -> Path:
        """Return the directory in which the unit is trained and its actor is kept."""
        return self.runs / self.study.run_name(unit)

    def load(self, units: Collection[Unit], seeds: int) -> Records:
        """Return the units' current records, after packing new ones from ``runs`` into the tables.

        Raises UserError: a record or a table is damaged, or another process keeps writing.
        """
        wanted = {unit: self.study.digest(unit) for unit in units}
        with util.held(self.results, WRITING_PATIENCE_S) as mine:
            if not mine:
                raise UserError(f"{self.results} is held by another process")
            tables = self._tables()
            if new := self._unpacked(wanted, tables):
                self._pack(tables, new)
                tables = self._tables()
        known = tables["units"].digest.to_dict()
        found = [unit for unit, digest in wanted.items() if known.get(unit) == digest]
        stale = [unit for unit in wanted if unit in known and unit not in found]
        current = {name: table[table.index.isin(found)] for name, table in tables.items()}
        return Records(self.study, current, found, stale, seeds)

    def _unpacked(
        self, wanted: Mapping[Unit, str], tables: Mapping[str, pd.DataFrame]
    ) -> dict[Unit, Record]:
        """Return the current records under ``runs`` that the tables lack."""
        known, records = tables["units"].digest.to_dict(), dict[Unit, Record]()
        for unit, digest in wanted.items():
            path = self.run_dir(unit) / RECORD_FILE
            if known.get(unit) != digest and path.is_file():
                record = read_json(path, "record")
                with util.fitting(f"{path} is no record of a unit"):
                    if record["units"]["digest"] == [digest]:
                        records[unit] = record
        return records

    def _tables(self) -> dict[str, pd.DataFrame]:
        """Return all tables, with the unit as their index; empty where there is no file."""
        tables = {}
        for name, columns in TABLES.items():
            path, table = self.results / f"{name}.csv.xz", pd.DataFrame(columns=KEY)
            with util.fitting(f"{path} is no table of records, or damaged"):
                if path.is_file():
                    table = pd.read_csv(path)
                table = table.set_index(KEY)
            tables[name] = table.reindex(columns=table.columns.union(columns, sort=False))
        return tables

    def _pack(self, tables: Mapping[str, pd.DataFrame], new: Mapping[Unit, Record]) -> None:
        """Rewrite the tables with new records, each file whole or not at all."""
        for name in TABLES:
            old = tables[name][~tables[name].index.isin(list(new))].reset_index()
            rows = (pd.DataFrame({**dict(zip(KEY, unit, strict=True)), **record[name]})
                    for unit, record in new.items() if name in record)  # fmt: skip
            if parts := [part for part in (old, *rows) if len(part)]:
                text = pd.concat(parts).sort_values(KEY, kind="stable").to_csv(index=False)
                packed = lzma.compress(text.encode(), preset=9)
                write_atomic(self.results / f"{name}.csv.xz", packed)


@dataclass
class Records:
    study: Study
    tables: Mapping[str, pd.DataFrame]
    found: list[Unit]
    stale: list[Unit]  # Units whose record, of other settings, is left out
    seeds: int  # Number of seeds wanted

    def of(self, task: str, line: Line) -> pd.DataFrame:
        """Return the numbers of a line's units, by seed; a line without training has seed 0."""
        n = self.numbers
        return n[(n.scenario == task) & (n.algorithm == line[0]) & (n.setting == line[1])]

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row a training episode: the costs up to its end, and its scores.

        Costs are the columns of ``SPENT``; a score like ``success alone`` is NaN if not validated.
        """
        rows = self.tables["episodes"]
        full_m = rows.index.get_level_values("scenario").map(lambda task: FULL_PATH_M.get(task))
        missed = rows.outcome.map(failed).astype(int)
        counted = rows[["human_steps", "takeovers"]].assign(episodes=1, failures=missed)
        spent = counted.groupby(KEY).cumsum().assign(steps=rows.end_step)
        period_s = self.tables["units"].period_s.reindex(rows.index)
        return spent.assign(
            human_s=spent.human_steps * period_s,
            **{f"{SUCCESS} {TRAINING}": (rows.outcome == GOAL).astype(float)},
            **{f"{REWARD} {TRAINING}": rows["return"]},
            **{f"{DISTANCE} {TRAINING}": rows[DISTANCE].clip(upper=full_m.to_numpy(float))},
            **{f"{score} {ALONE}": rows[f"validation_{score}"] for score in SCORES},
        )

    @cached_property
    def numbers(self) -> pd.DataFrame:
        """One row a unit: its columns of ``units``, its costs, and its tests by condition.

        Costs of a whole training have plain names (``human_s``); ``human_s_to_90%`` is the cost
        until the policy alone reached that level in validation, infinite if it never did;
        ``success alone, end`` is a mean over the last ``END_STEPS``.
        """
        units, rows = self.tables["units"].sort_index(), self.episodes
        costs = rows[SPENT].astype(float).groupby(KEY).last()
        success = rows[f"{SUCCESS} {ALONE}"]
        for level in LEVELS:
            first = rows.loc[is_reached(level, success), SPENT].astype(float).groupby(KEY).first()
            first = first.reindex(costs.index, fill_value=np.inf)
            costs = costs.join(first.add_suffix(f"_to_{level:.0%}"))
        for kind, score in product((TRAINING, ALONE), SCORES):
            measured = rows[["steps", f"{score} {kind}"]].dropna()
            last = measured.steps.groupby(KEY).transform("max")
            at_end = measured[measured.steps > last - END_STEPS]
            costs[f"{score} {kind}, end"] = at_end[f"{score} {kind}"].groupby(KEY).mean()
        # A mean of equals may be rounded up.
        lost = success.groupby(KEY).max() - costs[f"{SUCCESS} {ALONE}, end"]
        costs["unlearned"] = lost.clip(lower=0.0)
        tests = self.tables["tests"].pivot_table(index=KEY, columns="condition")
        tests.columns = [" ".join(column) for column in tests.columns]
        numbers = units.join([costs, tests]).reset_index()
        wanted = [f"{score} {condition}" for score, condition in product(SCORES, CONDITIONS)]
        return numbers.reindex(columns=numbers.columns.union(wanted, sort=False))

    def grid(self, task: str) -> Numbers:
        """Return the steps of a curve's points: multiples of the validation interval."""
        every = self.study.of(task).evaluate_every_steps
        return np.arange(every, self.study.steps[task] + 1, every, dtype=float)

    def curves(self, task: str, line: Line, name: str) -> Numbers:
        """Return a column of ``episodes`` at each point of the grid: [seeds, points].

        A training curve is the mean of the episodes since the point before, or the next episode if
        none ended in between; a curve of the policy alone is interpolated.
        """
        grid = self.grid(task)

        def curve(rows: pd.DataFrame) -> Numbers:
            steps, values = rows.steps.to_numpy(float), rows[name].to_numpy(float)
            if name.endswith(ALONE):
                return np.interp(grid, steps, values)
            next_one = np.searchsorted(steps, grid).clip(max=len(steps) - 1)
            means = pd.Series(values).groupby(np.searchsorted(grid, steps)).mean()
            return means.reindex(range(len(grid))).fillna(pd.Series(values[next_one])).to_numpy()

        units = self.of(task, line)[KEY].itertuples(index=False, name=None)
        rows = self.episodes.loc[self.episodes.index.isin([*units]), ["steps", name]].dropna()
        return np.array([curve(of) for _, of in rows.groupby(KEY)])
