"""Studies: which runs a table compares, with which settings and budgets, and the digest of each.

A new table is a new row of ``STUDIES`` and, if it needs them, of ``SETTINGS`` and ``TASKS``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

from trainer.environments import CONDITIONS
from trainer.learner.config import ALGORITHMS, FASTER

RESULTS_VERSION = 1
"""Raised by hand when a change of the code makes earlier records another experiment."""
FULL_PATH_M = {"left_turn": 21.0, "congestion": 80.0}  # Scenario -> distance from start to goal
SCENARIOS = tuple(FULL_PATH_M)
EXPERT, HUMAN_MODEL, CONSTANT = "expert", "human_model", "constant"
"""In an algorithm's place: the scripted expert or the human model alone, or the best constant
action. They are tested, not trained."""
TESTED_ONLY = (HUMAN_MODEL, CONSTANT)  # Those in the paper's experiments
TASKS: Mapping[str, tuple[str, str]] = {
    **{scenario: (scenario, EXPERT) for scenario in SCENARIOS},
    "hill": ("examples.tasks:examples/Hill-v0", "examples.tasks:HillExpert"),
    "racetrack": ("examples.tasks:examples/Racetrack-v0", "examples.racetrack:RacetrackExpert"),
}
"""Task -> the name of its environment and of its scripted expert."""
FOREIGN = tuple(task for task in TASKS if task not in SCENARIOS)  # They need a clone, and no Ray


@dataclass(frozen=True)
class Setting:
    """How the runs of a setting differ from the normal ones."""

    meaning: str
    run: Mapping[str, Any] = field(default_factory=dict)  # Fields of the run's config
    preset: str = "ours"  # Where the settings start from
    learner: Mapping[str, Any] = field(default_factory=dict)  # Hyper-parameters
    human: str = ""
    """Who guides: the task's ``expert``, ``module:Class`` of another script; empty: a model."""


NORMAL, ONE_FRAME, RANDOM, BIASED, PRINTED = "normal", "one_frame", "random", "biased", "printed"
POOR_SHARE = 1.0 / 3.0  # Share of the human's actions that poor guidance replaces (section VII-E)
GOOD, MODEL, SLOWER = "good", "model", "slower"
IMPERFECT: Mapping[str, Setting] = {
    "third_random": Setting(
        "a third of the actions is random", {"poor_guidance_share": POOR_SHARE}, human=EXPERT
    ),
    "late": Setting("0.3 to 0.8 s late", {"late_from_s": 0.3, "late_to_s": 0.8}, human=EXPERT),
    "seldom": Setting("overlooks two of three reasons", {"missed_share": 2.0 / 3.0}, human=EXPERT),
    "gives_up": Setting("leaves after 20 episodes", {"guided_until_episode": 20}, human=EXPERT),
    SLOWER: Setting("drives slower than is best", human="trainer.human.left_turn:SlowHuman"),
}
"""Humans with one fault each, in the left turn."""
HUMANS: Mapping[str, Setting] = {
    GOOD: Setting("the scripted expert", human=EXPERT),
    MODEL: Setting("the paper's model of it: one frame, 50 episodes"),
    **IMPERFECT,
}
"""Who guides in the table of human guidance, the same for all rows."""
SETTINGS: Mapping[str, Setting] = {
    **HUMANS,
    NORMAL: Setting("two frames, good guidance"),
    ONE_FRAME: Setting("one frame, the paper's tough setting", learner={"frames": 1}),
    RANDOM: Setting(
        "one third of the human's actions replaced by random ones, the paper's poor guidance",
        {"poor_guidance_share": POOR_SHARE},
    ),
    BIASED: Setting(
        "one third of the human's actions replaced by one wrong action, always the same",
        {"poor_guidance_share": POOR_SHARE, "poor_guidance": "biased"},
    ),
    PRINTED: Setting("numbers and equations as the paper prints them", preset="printed"),
}

LABELS = {
    "phil_td3": "PHIL-TD3",
    "ia_td3": "IA-TD3",
    "hi_td3": "HI-TD3",
    "per_td3": "vanilla TD3",
    "phil_td_only": "TD error alone",
    "phil_q_advantage_only": "Q advantage alone",
    "phil_advantage_0.1": "weight 0.1",
    "phil_advantage_100": "weight 100",
    "rd2_td3": "RD2-TD3",
    "rd2_phil": "RD2-PHIL",
    "phil_without_cloning": "without cloning",
    "phil_without_shaping": "without shaping",
    "cloning_only": "cloning alone (HG-DAgger)",
    "rlif_td3": "RLIF-TD3",
    "pvp_td3": "PVP-TD3",
    "pvp4real_td3": "PVP4Real-TD3",
    "ppl_td3": "PPL-TD3",
    "rlpd_td3": "RLPD-TD3",
    "phil_gated": "PHIL-TD3, the robot asks",
    EXPERT: "scripted expert",
    HUMAN_MODEL: "human model",
    CONSTANT: "best constant action",
}
FOUR = ("phil_td3", "ia_td3", "hi_td3", "per_td3")  # What the paper compares throughout
GUIDED = FOUR[:3]
TUNED: Mapping[str, Mapping[str, Any]] = dict.fromkeys(GUIDED, FASTER)
"""Row of the table of human guidance -> the hyper-parameters that its tuning chose there, where the
paper's experiments have others. What it chose for the other rows stands in ``ALGORITHMS``."""
NO_CLONING = ("phil_without_cloning",)
PARTS = (*NO_CLONING, "phil_without_shaping")
PRIORITIES = ("phil_td_only", "phil_q_advantage_only")
BUFFERS = ("rd2_phil", "rd2_td3")
WEIGHTS = ("phil_advantage_0.1", "phil_advantage_100")
ROWS = (
    *FOUR, "cloning_only", "rlif_td3", "pvp_td3", "pvp4real_td3", "rlpd_td3", "ppl_td3",
    "phil_gated",
)  # fmt: skip
"""Of the table of human guidance."""
HELPED = tuple(name for name in ROWS if ALGORITHMS[name].guided)
RIVALS = tuple(name for name in HELPED if name != "phil_td3")


class Line(NamedTuple):
    """An algorithm in a setting."""

    algorithm: str
    setting: str = NORMAL

    @property
    def name(self) -> str:
        """The algorithm in words, with its setting unless that is a usual one."""
        label = LABELS[self.algorithm]
        usual = self.setting in (NORMAL, GOOD) or self.algorithm == HUMAN_MODEL
        return label if usual else f"{label} ({words(self.setting)})"


def words(name: str) -> str:
    """A task or a setting as it is shown."""
    return name.replace("_", " ")


class Experiment(NamedTuple):
    """A figure or table of the paper, and the lines that it needs."""

    title: str
    algorithms: tuple[str, ...]
    settings: tuple[str, ...] = (NORMAL,)
    scenarios: tuple[str, ...] = SCENARIOS

    @property
    def lines(self) -> list[Line]:  # an algorithm's settings side by side
        return [Line(*each) for each in product(self.algorithms, self.settings)]


EXPERIMENTS: Mapping[str, Experiment] = {
    "fig7": Experiment("learning curves", FOUR),
    "fig8": Experiment("normal and tough setting", FOUR, (NORMAL, ONE_FRAME)),
    "fig9": Experiment("success and surviving distance", (*FOUR, *TESTED_ONLY)),
    "fig10": Experiment("time and smoothness", FOUR),
    "fig11": Experiment("what the priority is made of", ("phil_td3", *PRIORITIES)),
    "fig12": Experiment("weight of the Q advantage", ("phil_td3", *WEIGHTS)),
    "fig13": Experiment("one replay buffer or two", ("phil_td3", *BUFFERS)),
    "fig14": Experiment("surviving distance after poor guidance", GUIDED, (NORMAL, RANDOM, BIASED)),
    "fig15": Experiment("smoothness after poor guidance", GUIDED, (NORMAL, RANDOM)),
    "table1": Experiment(
        "beside the human, left turn", (*GUIDED, HUMAN_MODEL), scenarios=("left_turn",)
    ),
    "table2": Experiment(
        "beside the human, congestion", (*GUIDED, HUMAN_MODEL), scenarios=("congestion",)
    ),
    "ablation": Experiment("PHIL-TD3 without each of its parts", ("phil_td3", "ia_td3", *PARTS)),
    "time": Experiment("training time", FOUR, scenarios=("left_turn",)),
    "printed": Experiment("the settings as the paper prints them", FOUR, (NORMAL, PRINTED)),
    "floor": Experiment("the best constant action", (CONSTANT,)),
    "goals": Experiment(
        "what this project wants of the learner",
        (*FOUR, *NO_CLONING, *TESTED_ONLY),
        (NORMAL, BIASED),
    ),
    "cost": Experiment("what a training cost, and whether it lasts", FOUR),
}
"""The paper's: name on the command line -> what it is."""
BOXED = {*EXPERIMENTS["fig10"].lines, *EXPERIMENTS["fig15"].lines}
"""Lines of which single test drives are kept, for the boxes of these figures."""
BOXES = {
    "left_turn": ("time_s", "longitudinal_acceleration_mps2"),
    "congestion": ("lateral_acceleration_mps2",),
}
"""Scenario -> the quantities of these drives."""
ALL, STATUS, REPORT, TYPICAL = WORDS = ("all", "status", "report", "typical")
"""What may stand in the place of an experiment or a study."""
DEFAULT_SEEDS = 5
PAIRS = len(SCENARIOS) * DEFAULT_SEEDS
ENOUGH = 9  # Of these pairs: an equal row has so many by chance in one of 93 cases
MOST_EPISODES = 100  # In which a row of the table of human guidance is to learn
ID_LENGTH = 12


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
    def needs_human(self) -> bool:  # whether a human model decides its result
        guided = self.trained and ALGORITHMS[self.algorithm].guided
        return self.algorithm == HUMAN_MODEL or (guided and not SETTINGS[self.setting].human)

    @property
    def scripted_human(self) -> str:  # who guides, or whom the human model imitates
        human = SETTINGS[self.setting].human
        return human if ":" in human else TASKS[self.scenario][1]

    @property
    def conditions(self) -> tuple[str, ...]:  # under which it is tested
        return tuple(CONDITIONS) if self.scenario in SCENARIOS else ("nominal", "noise")


class StudyRow(NamedTuple):
    """Lines of a study: a setting or human, its algorithms, and where they are run."""

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

    name: str  # Of its page's template, and of its folders in ``results`` and ``runs``
    rows: tuple[StudyRow, ...]  # In the order of work
    steps: Mapping[str, int]
    """Task -> environment steps of a training, the same for every algorithm."""
    evaluate_every_steps: int = 500
    """Environment steps between two validations; the best validated actor is tested."""
    evaluation_runs: int = 50  # Drives of a validation
    test_runs: int = 250
    """Test drives in each scene, with the seeds 0, 1, ...: the paper's 50 first, then others."""
    together: int = 50  # Test drives side by side
    checkpoint_every: int = 5
    """Episodes between two checkpoints: what a kill costs, not what a run gives."""
    search_runs: int = 100
    """Validation drives of each constant action in the search for the best one."""
    search_points: int = 21  # Actions on each of the two grids of that search
    learner: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters changed for every algorithm alike."""
    slow: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Task -> fields that are others in it, since its steps take long."""

    def of(self, task: str) -> Study:
        """The study with what holds for one task."""
        return replace(self, **self.slow.get(task, {}))

    def quick(self) -> Study:
        """The same rows in a minute or two; the numbers mean nothing."""
        return replace(
            self, steps=dict.fromkeys(self.steps, 250), evaluate_every_steps=100,
            evaluation_runs=2, test_runs=3, together=3, checkpoint_every=1, search_runs=2,
            search_points=3, learner={"batch_size": 4, "warmup_steps": 16}, slow={},
        )  # fmt: skip

    def units(
        self, seeds: int, scenario: str | None = None, names: Collection[str] = (ALL,)
    ) -> list[Unit]:
        """The units of all rows, or of the paper's experiments of these names, each once.

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
        chosen = (EXPERIMENTS[name] for name in names)
        wanted = {each for one in chosen for each in product(one.scenarios, one.lines)}
        return [unit for unit in units if (unit.scenario, unit[1:3]) in wanted]

    def config(self, unit: Unit) -> dict[str, Any]:
        """What decides a unit's training, in plain words and values."""
        here, setting = self.of(unit.scenario), SETTINGS[unit.setting]
        human = HUMAN_MODEL if unit.needs_human else unit.scripted_human
        values = {"scenario": TASKS[unit.scenario][0], "algorithm": unit.algorithm, "human": human}
        if unit.algorithm == CONSTANT:
            return {**values, "search": [here.search_runs, here.search_points]}
        if not unit.trained:
            return values
        tuned = TUNED.get(unit.algorithm, {}) if unit.setting in HUMANS else {}
        own = ALGORITHMS[unit.algorithm].settings
        return {
            **values,
            "seed": unit.seed,
            "preset": setting.preset,
            "steps": here.steps[unit.scenario],
            "evaluate_every_steps": here.evaluate_every_steps,
            "evaluation_runs": here.evaluation_runs,
            **setting.run,
            "learner": {**own, **tuned, **here.learner, **setting.learner},
        }

    def run_name(self, unit: Unit) -> str:
        """Of the directory in which the unit is trained; tests that change do not touch it."""
        return f"{'-'.join(map(str, unit))}-{digest(self.config(unit))}"

    def digest(self, unit: Unit) -> str:
        """What a record must have to be current."""
        tests = {"test_runs": self.of(unit.scenario).test_runs, "version": RESULTS_VERSION}
        return digest({**self.config(unit), **tests})


def digest(values: Mapping[str, Any]) -> str:
    """Hash of plain values, whatever the order in which they stand."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_LENGTH]


PAPER = Study(
    "paper",
    (
        StudyRow(NORMAL, TESTED_ONLY, SCENARIOS, 0),
        StudyRow(NORMAL, FOUR),
        StudyRow(BIASED, GUIDED),
        StudyRow(PRINTED, FOUR),
        StudyRow(ONE_FRAME, FOUR),
        StudyRow(RANDOM, GUIDED),
        StudyRow(NORMAL, PARTS),
        StudyRow(BIASED, NO_CLONING),
        StudyRow(NORMAL, (*PRIORITIES, *BUFFERS)),
        StudyRow(NORMAL, WEIGHTS),
    ),
    steps={"left_turn": 6_000, "congestion": 6_000},
)
GUIDANCE = Study(
    "guidance",
    (
        StudyRow(GOOD, (EXPERT,), tuple(TASKS), 0),
        StudyRow(MODEL, (HUMAN_MODEL,), ("left_turn",), 0),
        StudyRow(SLOWER, (EXPERT,), ("left_turn",), 0),
        StudyRow(GOOD, ROWS),
        StudyRow(MODEL, HELPED, ("left_turn",)),
        StudyRow(GOOD, ROWS, FOREIGN, 3),
        *(StudyRow(human, HELPED, ("left_turn",)) for human in IMPERFECT),
    ),
    steps={"left_turn": 4_000, "congestion": 4_000, "hill": 4_000, "racetrack": 12_000},
    evaluate_every_steps=250,
    test_runs=100,
    slow={"racetrack": {"evaluate_every_steps": 1_000, "evaluation_runs": 20, "test_runs": 50}},
)
"""The fair table of human guidance, which is not the paper's."""
STUDIES = {study.name: study for study in (PAPER, GUIDANCE)}
PAPER_TESTS = 50
"""Of the test drives in a scene, the first so many have the paper's seeds (section VII-D)."""
