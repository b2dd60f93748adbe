"""A unit's result as it is kept: read, and refused where it is not what the unit wrote."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_runtime.episode_report import GOAL
from edge_runtime.errors import UserError
from edge_runtime.files import read_json
from trainer.experiments.plan import FULL_PATH_M
from trainer.experiments.store import TESTS_FILE, UNIT_FILE
from trainer.experiments.units import Unit
from trainer.experiments.work import KEPT_METRICS, KEPT_TESTS
from trainer.training.metrics import METRICS_FILE

Numbers = NDArray[np.float64]
Episodes = NDArray[np.int64]
"""Counted from 1."""
TEXT = ("outcome",)
"""Columns that are no numbers."""
LATER = {"validation_reward"}
"""Columns that the first results lack."""


@dataclass(frozen=True)
class Drives:
    """A policy's test episodes in one scene, in the order of their seeds."""

    columns: Mapping[str, Any]

    def __getitem__(self, name: str) -> Numbers:
        """One quantity, a value an episode; of ``reached`` 1 or 0."""
        values = self.reached if name == "reached" else self.columns[name]
        return np.asarray(values, dtype=float)

    @cached_property
    def reached(self) -> NDArray[np.bool_]:
        """Which episodes reached the goal."""
        return np.array([outcome == GOAL for outcome in self.columns["outcome"]])


@dataclass(frozen=True)
class Outcome:
    """What is kept of a unit."""

    unit: Unit
    metrics: Mapping[str, Any]
    """Column -> a value a training episode; nothing for the human model."""
    tests: Mapping[str, Drives]
    """Condition -> test episodes."""

    def measured(self, metric: str) -> tuple[Episodes, Numbers]:
        """Episodes, counted from 1, after which a metric was measured, and its values there.

        Most are measured after each one, a validation now and then.
        """
        values = np.asarray(self.metrics[metric], dtype=float)
        at = np.flatnonzero(~np.isnan(values))
        return at + 1, values[at]


def within_path(scenario: str, distances_m: Numbers) -> Numbers:
    """Surviving distances without what was driven beyond the goal: at most one step, and a matter
    of the speed there. Comparisons leave it out.
    """
    return np.minimum(distances_m, FULL_PATH_M[scenario])


def read_outcome(unit: Unit, directory: Path) -> Outcome:
    """A unit's result.

    Raises:
        UserError: the files are not what this project writes, or parts of them are missing.
    """
    try:
        about = read_json(directory / UNIT_FILE, "result")
        tests = _tests(directory / TESTS_FILE, about["test_runs"])
        metrics = {}
        if unit.trained:
            metrics = _metrics(directory / METRICS_FILE, about["run"]["episodes"])
        return Outcome(unit, metrics, tests)
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise UserError(f"the result in {directory} cannot be read: {reason}") from error


def _tests(path: Path, runs: int) -> dict[str, Drives]:
    conditions = read_json(path, "tests")
    for condition, columns in _mapping(conditions, path).items():
        _check_columns(_mapping(columns, path), KEPT_TESTS, path)
        for name, values in columns.items():
            if not isinstance(values, list) or len(values) != runs:
                raise ValueError(f"{path.name} has not {runs} values of {name} in {condition}")
            if name not in TEXT:
                np.asarray(values, dtype=float)
    return {name: Drives(columns) for name, columns in conditions.items()}


def _mapping(value: Any, path: Path) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{path.name} holds {type(value).__name__} in place of names and values")
    return value


def _check_columns(columns: Iterable[str], wanted: Iterable[str], path: Path) -> None:
    missing = set(wanted) - LATER - set(columns)
    if missing:
        raise ValueError(f"{path.name} lacks {', '.join(sorted(missing))}")


def _metrics(path: Path, episodes: int) -> dict[str, Any]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if len(rows) != episodes:
        raise ValueError(f"{path.name} has {len(rows)} of {episodes} episodes")
    _check_columns(rows[0], KEPT_METRICS, path)
    if any(None in (*row, *row.values()) for row in rows):
        raise ValueError(f"{path.name} has a row of another length")
    return {
        name: [row[name] for row in rows]
        if name in TEXT
        else np.array([float(row[name] or "nan") for row in rows])
        for name in rows[0]
    }
