"""The kept records as numbers: one a seed, their means and intervals, and the verdicts on these."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.outcomes import GOAL, failed
from bridge.statistics import Estimate, mean_estimate
from trainer.environments import CONDITIONS
from trainer.experiments import plan
from trainer.experiments.plan import NORMAL, ONE_FRAME, RANDOM, SCENARIOS, TESTED_ONLY, Unit
from trainer.experiments.run import TEST_COLUMNS, Store
from trainer.training.metrics import is_reached

Numbers = NDArray[np.float64]
Holds = Literal["yes", "no", "undecided"]


def above(difference: Estimate, least: float = 0.0) -> Holds:
    """Whether a number is above ``least``: decided where the interval lies on one side."""
    if difference.low > least:
        return "yes"
    return "no" if difference.high < least else "undecided"


def within(difference: Estimate, reach: float) -> Holds:
    """Whether a difference is at most ``reach`` either way."""
    if -reach <= difference.low and difference.high <= reach:
        return "yes"
    return "no" if difference.low > reach or difference.high < -reach else "undecided"


def enough_of(answers: Sequence[Holds], count: int = 0) -> Holds:
    """Yes if ``count`` are (0: all), no once too many are no."""
    least = count or len(answers)
    if len(answers) - answers.count("no") < least:
        return "no"
    return "yes" if answers and answers.count("yes") >= least else "undecided"


BySeed = dict[int, float]  # Training seed -> a number of that training
END_STEPS = 1_500  # What ended within so many steps of the last one is the end of a training
SUCCESS, DISTANCE, REWARD = "success", "distance_m", "reward"
TIME_S, LATERAL, LONGITUDINAL = "time_s", *TEST_COLUMNS[-2:]
ARRIVED_ONLY = (TIME_S, LATERAL, LONGITUDINAL)
"""Compared over drives that reach the goal only: a car that crashes at once is quick and smooth."""
SPREAD, SECONDS = "spread_m", "seconds"
"""Standard deviation of the surviving distance from drive to drive; what 10,000 training steps
took, validations apart."""
KEPT, DROPPED, CHANGED, UNLEARNED = "kept", "dropped", "changed", "unlearned"
"""Share of the final distance that is left with one frame instead of two; success in the nominal
scene minus that in the variant; relative change of the distance by random poor guidance; share of
validation drives by which the end lies below the best."""
TRAINING, ALONE = "in training", "alone"
"""A curve of the training episodes, in which the human helps (the paper's), or of the policy alone,
on validation seeds."""


class Line(NamedTuple):
    """An algorithm in a setting."""

    algorithm: str
    setting: str = NORMAL

    @property
    def name(self) -> str:
        """The algorithm in words, with its setting where that is not a usual one."""
        label = plan.LABELS[self.algorithm]
        usual = self.setting in (NORMAL, plan.GOOD) or self.algorithm == plan.HUMAN_MODEL
        return label if usual else f"{label} ({words(self.setting)})"


class Scene(NamedTuple):
    """A scenario under a test condition."""

    scenario: str
    condition: str

    @property
    def label(self) -> str:
        """As in the paper's figure 9: L, L-N, L-V, C, ..."""
        letter = self.scenario[0].upper()
        return letter if self.condition == "nominal" else f"{letter}-{self.condition[0].upper()}"


Place = str | Scene  # A scenario, for its trainings, or a scene of the tests
EVERYWHERE = "mean of the scenes"  # A place, too: the paper's six scenes together


def words(place: Place) -> str:
    """A scenario, a setting or a scene as it is shown."""
    return place.replace("_", " ") if isinstance(place, str) else place.label


SCENES = tuple(Scene(scenario, condition) for scenario in SCENARIOS for condition in CONDITIONS)
PAPER_SCENES = tuple(s for s in SCENES if s.condition in ("nominal", "noise", "variant"))


class Costs(NamedTuple):
    """What a training, or its beginning, cost."""

    human_steps: int
    takeovers: int
    failures: int  # Training episodes that missed the goal, whoever drove
    episodes: int
    human_s: float
    steps: float  # Of the environment


@dataclass(frozen=True)
class Result:
    """A unit's record."""

    unit: Unit
    record: Mapping[str, Any]

    @property
    def every_steps(self) -> int:
        """The distance between two validations."""
        return int(self.record["config"]["evaluate_every_steps"])

    @cached_property
    def grid(self) -> Numbers:
        """The multiples of that distance up to the budget of steps."""
        budget = int(self.record["config"]["steps"])
        return np.arange(self.every_steps, budget + 1, self.every_steps, dtype=float)

    def points(self, kind: str, metric: str) -> tuple[Numbers, Numbers]:
        """At which steps a metric was measured, and its values; in training once an episode."""
        if kind == ALONE:
            columns = self.record["validation"]
            return np.asarray(columns["at_step"], float), np.asarray(columns[metric], float)
        columns = self.record["training"]
        if metric == SUCCESS:
            values = np.array([outcome == GOAL for outcome in columns["outcome"]], float)
        else:
            values = np.asarray(columns["return" if metric == REWARD else metric], float)
        values = self._cut(values) if metric == DISTANCE else values
        return np.asarray(columns["end_step"], float), values

    def curve(self, kind: str, metric: str) -> Numbers:
        """A metric at each point of the grid.

        In training it is the mean of the episodes since the point before, or of the next one
        where none ended there.
        """
        steps, values = self.points(kind, metric)
        if kind == ALONE:
            return np.interp(self.grid, steps, values)
        means = []
        for end in self.grid:
            inside = (steps > end - self.every_steps) & (steps <= end)
            next_one = min(int(np.searchsorted(steps, end)), len(values) - 1)
            means.append(values[inside].mean() if inside.any() else values[next_one])
        return np.array(means)

    def end(self, kind: str, metric: str) -> float:
        """Mean of what was measured in the last ``END_STEPS`` steps."""
        steps, values = self.points(kind, metric)
        return float(values[steps > steps[-1] - END_STEPS].mean())

    @property
    def unlearned(self) -> float:
        """Share of validation drives by which the end lies below the best validation."""
        best = float(max(self.record["validation"]["success"]))
        return max(best - self.end(ALONE, SUCCESS), 0.0)  # A mean of equals may be rounded up

    @property
    def costs(self) -> Costs:
        """What the whole training cost."""
        return self._costs_at(self.record["training"]["end_step"][-1])

    def until(self, level: float) -> Costs | None:
        """What it cost until the policy alone reached ``level`` in validation; None: never."""
        columns = self.record["validation"]
        steps = zip(columns["at_step"], columns["success"], strict=True)
        there = [step for step, success in steps if is_reached(level, success)]
        return self._costs_at(there[0]) if there else None

    def given(self) -> Numbers:
        """Seconds that the human had driven at each point of the grid."""
        return np.array([self._costs_at(step).human_s for step in self.grid])

    def _costs_at(self, step: float) -> Costs:
        columns = self.record["training"]
        so_far = np.asarray(columns["end_step"]) <= step
        human, takeovers = (np.asarray(columns[n])[so_far] for n in ("human_steps", "takeovers"))
        outcomes = np.asarray(columns["outcome"])[so_far]
        human_steps, period_s = int(human.sum()), self.record.get("period_s", 0.1)
        failures = sum(map(failed, outcomes.tolist()))
        counts = human_steps, int(takeovers.sum()), failures, len(outcomes)
        return Costs(*counts, human_steps * period_s, step)

    def reached(self, condition: str) -> NDArray[np.bool_]:
        """Which test drives reached the goal, by seed."""
        return np.array([outcome == GOAL for outcome in self.record["tests"][condition]["outcome"]])

    def drives(self, condition: str, quantity: str) -> Numbers:
        """A quantity of each test drive; distances end at the goal, as how far the last step goes
        beyond it only shows the speed.
        """
        if quantity == SUCCESS:
            return self.reached(condition).astype(float)
        values = np.asarray(self.record["tests"][condition][quantity], float)
        return self._cut(values) if quantity == DISTANCE else values

    def mean(self, condition: str, quantity: str) -> float:
        """A quantity's mean over the test drives; nan where none arrives that could count."""
        if quantity == SPREAD:
            return float(self.drives(condition, DISTANCE).std())
        values = self.drives(condition, quantity)
        if quantity in ARRIVED_ONLY:
            values = values[self.reached(condition)]
        return float(values.mean()) if len(values) else float("nan")

    @property
    def seconds(self) -> float:
        """What 10,000 steps of the training took."""
        return 1e4 * self.record["computed"]["training_s"] / self.record["totals"]["steps"]

    def _cut(self, distances_m: Numbers) -> Numbers:
        return np.minimum(distances_m, plan.FULL_PATH_M.get(self.unit.scenario, np.inf))


@dataclass(frozen=True)
class Results:
    """The results of a plan."""

    found: Mapping[Unit, Result]
    seeds: int  # How many are wanted
    stale: Collection[Unit] = ()  # Units whose record is of other settings, and left out

    def of(self, scenario: str, line: Line) -> list[Result]:
        """What there is of a line in a scenario, by seed; what is only tested has seed 0."""
        units = [Unit(scenario, *line, seed) for seed in range(self.seeds + 1)]
        return [self.found[unit] for unit in units if unit in self.found]

    def complete(self, place: Place, line: Line, quantity: str) -> bool:
        """Whether all trainings that this number needs are there."""
        scenario = place.scenario if isinstance(place, Scene) else place
        scenarios = SCENARIOS if scenario == EVERYWHERE else (scenario,)
        other = {KEPT: ONE_FRAME, CHANGED: RANDOM}.get(quantity, line.setting)
        wanted = 1 if line.algorithm in TESTED_ONLY else self.seeds
        needed = product(scenarios, (line, Line(line.algorithm, other)))
        return all(len(self.of(*each)) == wanted for each in needed)

    def numbers(self, place: Place, line: Line, quantity: str, kind: str = ALONE) -> BySeed:
        """One number a training: where it ends in a scenario, or its test drives' mean in a scene.

        ``kind`` is that of the curves in a scenario.
        """
        if quantity == CHANGED:
            scenes = [place] if isinstance(place, Scene) else PAPER_SCENES
            ratios = self._ratios(scenes, line, RANDOM, kind)
            return {seed: ratio - 1.0 for seed, ratio in ratios.items()}
        if isinstance(place, Scene):
            found = self.of(place.scenario, line)
            return {r.unit.seed: r.mean(place.condition, quantity) for r in found}
        if quantity == KEPT:
            return self._ratios([place], line, ONE_FRAME, kind)
        if quantity == DROPPED:
            nominal, variant = (
                self.numbers(Scene(place, condition), line, SUCCESS)
                for condition in ("nominal", "variant")
            )
            return {seed: nominal[seed] - variant[seed] for seed in nominal}
        if quantity in (SECONDS, UNLEARNED):
            return {r.unit.seed: getattr(r, quantity) for r in self.of(place, line)}
        return {r.unit.seed: r.end(kind, quantity) for r in self.of(place, line)}

    def estimate(self, place: Place, line: Line, quantity: str, kind: str = ALONE) -> Estimate:
        """Mean and interval of the seeds' numbers."""
        return mean_estimate(self.numbers(place, line, quantity, kind).values())

    def _ratios(self, at: Sequence[Place], line: Line, setting: str, kind: str) -> BySeed:
        """Each seed's part in the ratio of the distances, that setting over the line's own."""
        lines = Line(line.algorithm, setting), line
        found = [_ratio(*(self.numbers(one, each, DISTANCE, kind) for each in lines)) for one in at]
        seeds = [seed for seed in found[0] if all(seed in one for one in found)]
        return {seed: float(np.mean([one[seed] for one in found])) for seed in seeds}

    def pooled(self, scene: Scene, line: Line, quantity: str, paper: bool = False) -> Numbers:
        """A quantity of all drives of all seeds; of those with the paper's seeds alone."""
        count = plan.PAPER_TESTS if paper else None
        parts = [r.drives(scene.condition, quantity)[:count] for r in self.of(scene.scenario, line)]
        return np.concatenate([np.zeros(0), *parts])

    def differences(
        self, place: Place, first: Line, second: Line, quantity: str, kind: str = ALONE
    ) -> BySeed:
        """First minus second, paired by training seed; what is not trained pairs with every seed.

        What is compared of arrivals only is the mean over the test drives in which both arrive.
        """
        if not (quantity in ARRIVED_ONLY and isinstance(place, Scene)):
            own, other = (self.numbers(place, line, quantity, kind) for line in (first, second))
            pairs = {seed: other.get(seed, other.get(0)) for seed in own}
            return {seed: own[seed] - its for seed, its in pairs.items() if its is not None}
        theirs = {result.unit.seed: result for result in self.of(place.scenario, second)}
        found = {}
        for result in self.of(place.scenario, first):
            rival = theirs.get(result.unit.seed, theirs.get(0))
            if rival is None:
                continue
            both = result.reached(place.condition) & rival.reached(place.condition)
            if both.any():
                values = (r.drives(place.condition, quantity)[both] for r in (result, rival))
                found[result.unit.seed] = float(np.subtract(*values).mean())
        return found


def _ratio(above: BySeed, below: BySeed) -> BySeed:
    """Each seed's part in the ratio of two means.

    The mean of these is the ratio of the means, and their spread that ratio's to first order. A
    mean of the seeds' own ratios would be ruled by a seed that learned next to nothing.
    """
    seeds = sorted(above.keys() & below.keys())
    mean = float(np.mean([below[seed] for seed in seeds])) if seeds else 0.0
    if not mean:
        return {}
    ratio = float(np.mean([above[seed] for seed in seeds])) / mean
    return {seed: ratio + (above[seed] - ratio * below[seed]) / mean for seed in seeds}


def load(store: Store, seeds: int, name: str = "all") -> Results:
    """What there is of an experiment, or of all the paper's."""
    found, stale = store.find(plan.units_of([name], seeds))
    return Results({unit: Result(unit, record) for unit, record in found.items()}, seeds, stale)
