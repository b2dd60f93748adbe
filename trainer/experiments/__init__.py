"""Define the studies: the runs of each table, their settings and budgets, and a digest of each.

The data is in ``plan.toml``; a new table is a new study there.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trainer.environments import CONDITIONS
from trainer.learner.config import ALGORITHMS, FASTER, task_settings

RESULTS_VERSION = 1
"""Raise by hand when a change of the code would give other records than the earlier ones."""
DATA: Mapping[str, Any] = tomllib.loads(Path(__file__).with_name("plan.toml").read_text())
for _row in (
    *DATA["experiments"].values(),
    *(row for study in DATA["studies"].values() for row in study["rows"]),
):
    _groups = (DATA["groups"].get(name, [name]) for name in _row["algorithms"])
    _row["algorithms"] = [name for names in _groups for name in names]
LABELS: Mapping[str, str] = DATA["labels"]
TASKS: Mapping[str, Mapping[str, Any]] = DATA["tasks"]
FULL_PATH_M: Mapping[str, float] = {
    name: task["full_path_m"] for name, task in TASKS.items() if "full_path_m" in task
}
SCENARIOS = tuple(FULL_PATH_M)
HUMAN_MODEL, CONSTANT = "human_model", "constant"
"""Used instead of an algorithm: the human model alone, or the best constant action."""
BEST_CONSTANT: Mapping[str, Any] = DATA["best_constant"]
HUMANS: Mapping[str, Any] = DATA["humans"]
"""Who guides in the table of human guidance."""
SETTINGS: Mapping[str, Any] = {**HUMANS, **DATA["settings"]}
NORMAL, GOOD = "normal", "good"
ROWS, HELPED = (tuple(DATA["groups"][name]) for name in ("rows", "helped"))
"""Rows of the table of human guidance, and those that a human helps."""
RIVALS = tuple(name for name in HELPED if name != "phil_td3")
SHOWN: Mapping[str, Mapping[str, Any]] = DATA["shown"]
"""Row of the table of human guidance whose human does not take over -> its settings of a run."""
TUNED: Mapping[str, Mapping[str, Any]] = dict.fromkeys(DATA["groups"]["guided"], FASTER)
"""Row of the table of human guidance -> hyper-parameters that its tuning chose in our scenes, but
that the paper's experiments do not use. Those of other rows are in ``ALGORITHMS``."""
DEFAULT_SEEDS = 5
PAPER_TESTS = 50
"""The first of the test drives in a scene, which have the paper's seeds (section VII-D)."""


def words(name: str) -> str:
    return name.replace("_", " ")


class Line(NamedTuple):
    algorithm: str
    setting: str = NORMAL

    @property
    def name(self) -> str:
        """The algorithm in words, with its setting unless that is a usual one."""
        label = LABELS[self.algorithm]
        usual = self.setting in (NORMAL, GOOD) or self.algorithm == HUMAN_MODEL
        return label if usual else f"{label} ({words(self.setting)})"


@dataclass(frozen=True)
class Experiment:
    """A figure or table of the paper, and the lines that it needs."""

    title: str
    algorithms: tuple[str, ...]
    settings: tuple[str, ...] = (NORMAL,)
    scenarios: tuple[str, ...] = SCENARIOS

    @property
    def lines(self) -> list[Line]:  # an algorithm's settings side by side
        return [Line(*each) for each in product(self.algorithms, self.settings)]


class Unit(NamedTuple):
    """One training with its tests, or tests alone."""

    scenario: str
    algorithm: str
    setting: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scenario} {self.algorithm} {self.setting} seed {self.seed}"

    @property
    def trained(self) -> bool:
        return self.algorithm in ALGORITHMS

    @property
    def needs_human(self) -> bool:
        """Whether a human model decides its result."""
        guided = self.trained and ALGORITHMS[self.algorithm].guided
        by_model = guided and "human" not in SETTINGS[self.setting]
        return self.algorithm == HUMAN_MODEL or by_model

    @property
    def scripted_human(self) -> str:
        """The scripted human who guides, or whom the human model imitates."""
        human: str = SETTINGS[self.setting].get("human", "")
        return human if ":" in human else TASKS[self.scenario]["expert"]

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(CONDITIONS) if self.scenario in SCENARIOS else ("nominal", "noise")


@dataclass(frozen=True)
class StudyRow:
    """Lines of a study: a setting or human, its algorithms, and their tasks."""

    setting: str
    algorithms: tuple[str, ...]
    tasks: tuple[str, ...] = SCENARIOS
    seeds: int = 1000  # At most; 0: tested only

    @property
    def lines(self) -> list[Line]:
        return [Line(algorithm, self.setting) for algorithm in self.algorithms]


@dataclass(frozen=True)
class Study:
    """A table of runs: its rows, and what all of its units have in common."""

    rows: tuple[StudyRow, ...]  # In the order of work
    steps: Mapping[str, int]
    """Task -> environment steps of a training, the same for every algorithm."""
    evaluate_every_steps: int = 500
    """Environment steps between two validations; the best validated actor is tested."""
    evaluation_runs: int = 50  # Drives of a validation
    confirmation_factor: int = 0  # As in ``RunConfig``
    test_runs: int = 250
    """Test drives in each scene, with the seeds 0, 1, ...: the paper's 50 first, then others."""
    checkpoint_every: int = 5
    """Episodes between two checkpoints; affects what a kill loses, not the result."""
    learner: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters changed for every algorithm alike."""
    by_task: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Task -> fields with other values in it."""
    name: str = ""  # Names the page's template and the folders in ``results`` and ``runs``

    def of(self, task: str) -> Study:
        return replace(self, **self.by_task.get(task, {}))

    def quick(self) -> Study:
        """Return the same rows in a minute or two; the numbers mean nothing."""
        return replace(self, steps=dict.fromkeys(self.steps, 250), **DATA["quick"])

    def units(
        self, seeds: int, scenario: str | None = None, names: Collection[str] = ("all",)
    ) -> list[Unit]:
        """Return the units of all rows, or of the paper's experiments of these names, each once.

        Seed by seed within a row, so that work that stops early leaves balanced results.
        """
        units = [
            Unit(task, algorithm, row.setting, seed)
            for row in self.rows
            for seed in (range(1, min(seeds, row.seeds) + 1) if row.seeds else [0])
            for task, algorithm in product(row.tasks, row.algorithms)
            if scenario in (None, task)
        ]
        if not EXPERIMENTS.keys() >= set(names):
            return units
        chosen = [EXPERIMENTS[name] for name in names]
        wanted = {pair for each in chosen for pair in product(each.scenarios, each.lines)}
        return [unit for unit in units if (unit.scenario, unit[1:3]) in wanted]

    def config(self, unit: Unit) -> dict[str, Any]:
        """Return all settings that decide a unit's training, as plain values."""
        here, setting = self.of(unit.scenario), SETTINGS[unit.setting]
        human = HUMAN_MODEL if unit.needs_human else unit.scripted_human
        scenario = TASKS[unit.scenario]["environment"]
        values = {"scenario": scenario, "algorithm": unit.algorithm, "human": human}
        if unit.algorithm == CONSTANT:
            return {**values, "search": BEST_CONSTANT["search"]}
        if not unit.trained:
            return values
        is_tuned = unit.setting in HUMANS and unit.scenario in SCENARIOS
        tuned = TUNED.get(unit.algorithm, {}) if is_tuned else {}
        row, of_task = ALGORITHMS[unit.algorithm], dict[str, float]()
        if period_s := TASKS[unit.scenario].get("numbers_period_s"):
            of_task = task_settings(row, numbers=True, period_s=period_s)
        factor = here.confirmation_factor
        confirmed = {"confirmation_factor": factor} if factor else {}  # Keeps old digests
        return {
            **values,
            "seed": unit.seed,
            "preset": setting.get("preset", "ours"),
            "steps": here.steps[unit.scenario],
            "evaluate_every_steps": here.evaluate_every_steps,
            "evaluation_runs": here.evaluation_runs,
            **confirmed,
            **setting.get("run", {}),
            **(SHOWN.get(unit.algorithm, {}) if unit.setting in HUMANS else {}),
            "learner": {
                **of_task,
                **row.settings,
                **tuned,
                **here.learner,
                **setting.get("learner", {}),
            },
        }

    def run_name(self, unit: Unit) -> str:
        """Return the name of the unit's training directory; its tests do not change it."""
        return f"{'-'.join(map(str, unit))}-{digest(self.config(unit))}"

    def digest(self, unit: Unit) -> str:
        """Return the digest of a current record: of training, tests and `RESULTS_VERSION`."""
        tests = {"test_runs": self.of(unit.scenario).test_runs, "version": RESULTS_VERSION}
        return digest({**self.config(unit), **tests})


def digest(values: Mapping[str, Any]) -> str:
    """Hash plain values, independent of their order."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


EXPERIMENTS: Mapping[str, Experiment] = msgspec.convert(DATA["experiments"], dict[str, Experiment])
"""The paper's experiments, by their names on the command line."""
STUDIES: Mapping[str, Study] = {
    name: replace(study, name=name)
    for name, study in msgspec.convert(DATA["studies"], dict[str, Study]).items()
}
PAPER, GUIDANCE = STUDIES["paper"], STUDIES["guidance"]
"""The paper's experiments, and the fair table of human guidance, which is not the paper's."""
