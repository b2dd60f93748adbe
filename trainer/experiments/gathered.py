"""The finished units of an experiment, as arrays to draw and to judge."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from trainer.experiments.outcome import Numbers, Outcome, read_outcome
from trainer.experiments.plan import NORMAL, Scene
from trainer.experiments.store import Store
from trainer.experiments.units import Unit


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


def comparable(first: Outcome, second: Outcome) -> bool:
    """Whether two policies are of one training seed; the human model, of which there is one, goes
    with each.
    """
    trained = first.unit.trained and second.unit.trained
    return first.unit.seed == second.unit.seed or not trained


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
        second: of another.
        condition: of the scene.
        quantity: a column of the tests.
        arrived: only pairs in which both reached the goal.
    """
    ours: list[Numbers] = []
    theirs: list[Numbers] = []
    for one in first:
        for other in second:
            if not comparable(one, other):
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


def gather(store: Store, units: Iterable[Unit], seeds: int) -> Gathered:
    """Read what the store has of these units."""
    wanted = list(units)
    finished = [unit for unit in wanted if store.state(unit) == "done"]
    found = {unit: read_outcome(unit, store.result_dir(unit)) for unit in finished}
    return Gathered(wanted, found, seeds)
