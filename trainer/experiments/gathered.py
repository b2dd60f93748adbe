"""The finished units of an experiment, as arrays to draw and to judge."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_runtime.episode_report import GOAL
from edge_runtime.errors import UserError
from trainer.experiments.plan import FULL_PATH_M, NORMAL, Scene
from trainer.experiments.store import TESTS_FILE, Store
from trainer.experiments.units import Unit
from trainer.training.metrics import METRICS_FILE

Numbers = NDArray[np.float64]
Episodes = NDArray[np.int64]
"""Counted from 1."""
TEXT = ("outcome",)
"""Columns that are no numbers."""


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

    @property
    def best_validation(self) -> float:
        """Success of the actor that was tested, on the validation seeds of its run."""
        return float(self.measured("validation_success")[1].max())


class Gathered:
    """What there is of an experiment.

    Args:
        wanted: the units that it needs.
        found: those that are finished.
        seeds: how many seeds it wants.
    """

    def __init__(self, wanted: Iterable[Unit], found: Mapping[Unit, Outcome], seeds: int) -> None:
        self.wanted, self.found, self.seeds = tuple(wanted), dict(found), seeds

    @property
    def missing(self) -> list[Unit]:
        """Units that are not finished."""
        return [unit for unit in self.wanted if unit not in self.found]

    def of(self, scenario: str, algorithm: str, setting: str = NORMAL) -> list[Outcome]:
        """The finished units of an algorithm, by seed."""
        key = (scenario, algorithm, setting)
        units = [u for u in self.found if (u.scenario, u.algorithm, u.setting) == key]
        return [self.found[unit] for unit in sorted(units, key=lambda unit: unit.seed)]

    def complete(self, scenario: str, algorithms: Iterable[str], setting: str = NORMAL) -> bool:
        """Whether no unit of these algorithms is missing."""
        chosen = set(algorithms)
        return not any(
            unit.algorithm in chosen and (unit.scenario, unit.setting) == (scenario, setting)
            for unit in self.missing
        )

    def tested(self, scene: Scene, algorithm: str, setting: str = NORMAL) -> list[Outcome]:
        """The finished units of an algorithm that were tested in a scene."""
        outcomes = self.of(scene.scenario, algorithm, setting)
        return [outcome for outcome in outcomes if scene.condition in outcome.tests]


def pairs(
    first: list[Outcome],
    second: list[Outcome],
    condition: str,
    quantity: str,
    arrived: bool = False,
) -> tuple[Numbers, Numbers]:
    """A quantity of two policies' test episodes, paired by training seed and test seed.

    Args:
        first: outcomes of one algorithm, tested in the condition.
        second: of another. The human model, of which there is one, pairs with every seed.
        condition: of the scene.
        quantity: a column of the tests.
        arrived: only pairs in which both reached the goal.
    """
    ours: list[Numbers] = []
    theirs: list[Numbers] = []
    for one in first:
        for other in second:
            if one.unit.seed != other.unit.seed and one.unit.trained and other.unit.trained:
                continue
            a, b = one.tests[condition], other.tests[condition]
            kept = a.reached & b.reached if arrived else np.ones(len(a.reached), dtype=bool)
            ours.append(a[quantity][kept])
            theirs.append(b[quantity][kept])
    nothing = np.zeros(0)
    return np.concatenate([nothing, *ours]), np.concatenate([nothing, *theirs])


def pooled(
    outcomes: list[Outcome], condition: str, quantity: str, arrived: bool = False
) -> Numbers:
    """A quantity of all test episodes of some outcomes, one after the other."""
    values = []
    for outcome in outcomes:
        tests = outcome.tests[condition]
        values.append(tests[quantity][tests.reached] if arrived else tests[quantity])
    return np.concatenate([np.zeros(0), *values])


def within_path(scene: Scene, distances_m: Numbers) -> Numbers:
    """Surviving distances without what was driven beyond the goal: at most one step, and a matter
    of the speed there. Comparisons leave it out.
    """
    return np.minimum(distances_m, FULL_PATH_M[scene.scenario])


def gather(store: Store, units: Iterable[Unit], seeds: int) -> Gathered:
    """Read what the store has of these units."""
    wanted = list(units)
    finished = [unit for unit in wanted if store.state(unit) == "done"]
    found = {unit: read_outcome(unit, store.result_dir(unit)) for unit in finished}
    return Gathered(wanted, found, seeds)


def read_outcome(unit: Unit, directory: Path) -> Outcome:
    """A unit's result.

    Raises:
        UserError: the files are not what this project writes.
    """
    try:
        metrics = _read_csv(directory / METRICS_FILE) if unit.trained else {}
        tests = json.loads((directory / TESTS_FILE).read_bytes())
        return Outcome(unit, metrics, {name: Drives(columns) for name, columns in tests.items()})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"the result in {directory} cannot be read: {error}") from error


def _read_csv(path: Path) -> dict[str, Any]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path.name} has no rows")
    return {
        name: [row[name] for row in rows]
        if name in TEXT
        else np.array([float(row[name] or "nan") for row in rows])
        for name in rows[0]
    }
