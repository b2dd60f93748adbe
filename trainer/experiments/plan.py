"""What the paper's experiments train and test: lines, settings and budgets, and a unit's id."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge_runtime.util import read_bytes
from trainer.environments import COMMAND_NOISE, CONDITIONS, expert_of, make_environment
from trainer.human.config import MODEL_FILE
from trainer.human.guide import HumanGuide, steps_held
from trainer.learner.config import ALGORITHMS, FASTER, Algorithm
from trainer.training.config import BIASED as BIASED_GUIDANCE
from trainer.training.config import LATER, PRESETS, RunConfig

FULL_PATH_M = {"left_turn": 21.0, "congestion": 80.0}  # Scenario -> distance from start to goal
SCENARIOS = tuple(FULL_PATH_M)

FOREIGN = {
    "hill": ("examples.tasks:examples/Hill-v0", "examples.tasks:HillExpert"),
    "racetrack": ("examples.tasks:examples/Racetrack-v0", "examples.racetrack:RacetrackExpert"),
}
"""Word of a task that is none of our scenarios -> its environment and its scripted expert."""
EXPERT, HUMAN_MODEL, CONSTANT = "expert", "human_model", "constant"
"""In an algorithm's place: the scripted expert or the human model alone, or the best constant
action. They are tested, not trained."""
TESTED_ONLY = (HUMAN_MODEL, CONSTANT)  # Those in the paper's experiments


@dataclass(frozen=True)
class Setting:
    """How the runs of a setting differ from the normal ones."""

    meaning: str
    run: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the run's config that it changes."""
    preset: str = "ours"  # Where its settings start from
    learner: Mapping[str, Any] = field(default_factory=dict)  # Hyper-parameters that it changes
    human: str = ""
    """Who guides: the task's ``expert``, ``module:Class`` of another script; empty: a model."""


NORMAL, ONE_FRAME, RANDOM, BIASED, PRINTED = "normal", "one_frame", "random", "biased", "printed"
POOR_SHARE = 1.0 / 3.0  # Share of the human's actions that poor guidance replaces (section VII-E)
GOOD, MODEL = "good", "model"
IMPERFECT: Mapping[str, Setting] = {
    "third_random": Setting(
        "a third of the actions is random", {"poor_guidance_share": POOR_SHARE}, human=EXPERT
    ),
    "late": Setting("0.3 to 0.8 s late", {"late_from_s": 0.3, "late_to_s": 0.8}, human=EXPERT),
    "seldom": Setting("overlooks two of three reasons", {"missed_share": 2.0 / 3.0}, human=EXPERT),
    "gives_up": Setting("leaves after 20 episodes", {"guided_until_episode": 20}, human=EXPERT),
    "slower": Setting("drives slower than is best", human="trainer.human.left_turn:SlowHuman"),
}
"""Humans with one fault each, in the left turn."""
HUMANS: Mapping[str, Setting] = {
    GOOD: Setting("the scripted expert", human=EXPERT),
    MODEL: Setting("the paper's model of it: one frame, 50 episodes"),
    **IMPERFECT,
}
"""Who guides in the table of human guidance, the same for all rows."""
TUNED: Mapping[str, Mapping[str, Any]] = dict.fromkeys(("phil_td3", "ia_td3", "hi_td3"), FASTER)
"""Row of the table of human guidance -> the hyper-parameters that its tuning chose there, where the
paper's experiments have others. What it chose for the other rows stands in ``ALGORITHMS``."""
SETTINGS: Mapping[str, Setting] = {
    **HUMANS,
    NORMAL: Setting("two frames, good guidance"),
    ONE_FRAME: Setting("one frame, the paper's tough setting", learner={"frames": 1}),
    RANDOM: Setting(
        "one third of the human's actions replaced by random ones, the paper's poor guidance",
        run={"poor_guidance_share": POOR_SHARE},
    ),
    BIASED: Setting(
        "one third of the human's actions replaced by one wrong action, always the same",
        run={"poor_guidance_share": POOR_SHARE, "poor_guidance": BIASED_GUIDANCE},
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
NO_CLONING = ("phil_without_cloning",)
PARTS = (*NO_CLONING, "phil_without_shaping")
PRIORITIES = ("phil_td_only", "phil_q_advantage_only")
BUFFERS = ("rd2_phil", "rd2_td3")
WEIGHTS = ("phil_advantage_0.1", "phil_advantage_100")
LEFT, JAM = ("left_turn",), ("congestion",)
DEFAULT_SEEDS, MANY = 5, 1000
Lines = tuple[tuple[str, tuple[str, ...], tuple[str, ...], int], ...]
"""Setting or human, algorithms, tasks, and how many seeds at most; 0: tested only."""
LINES: Lines = (
    (NORMAL, TESTED_ONLY, SCENARIOS, 0),
    (NORMAL, FOUR, SCENARIOS, MANY),
    (BIASED, GUIDED, SCENARIOS, MANY),
    (PRINTED, FOUR, SCENARIOS, MANY),
    (ONE_FRAME, FOUR, SCENARIOS, MANY),
    (RANDOM, GUIDED, SCENARIOS, MANY),
    (NORMAL, PARTS, SCENARIOS, MANY),
    (BIASED, NO_CLONING, SCENARIOS, MANY),
    (NORMAL, (*PRIORITIES, *BUFFERS), SCENARIOS, MANY),
    (NORMAL, WEIGHTS, SCENARIOS, MANY),
)
"""All of the paper's, in the order of work."""
WORDS = ALL, STATUS, REPORT, GUIDANCE, TYPICAL = "all", "status", "report", "guidance", "typical"
"""What may stand in an experiment's place. Guidance is the fair table of human guidance, which is
not the paper's."""
ROWS = (
    *FOUR, "cloning_only", "rlif_td3", "pvp_td3", "pvp4real_td3", "rlpd_td3", "ppl_td3",
    "phil_gated",
)  # fmt: skip
HELPED = tuple(name for name in ROWS if ALGORITHMS[name].guided)
GUIDANCE_LINES: Lines = (
    (GOOD, (EXPERT,), (*SCENARIOS, *FOREIGN), 0),
    (MODEL, (HUMAN_MODEL,), LEFT, 0),
    ("slower", (EXPERT,), LEFT, 0),
    (GOOD, ROWS, SCENARIOS, MANY),
    (MODEL, HELPED, LEFT, MANY),
    (GOOD, ROWS, tuple(FOREIGN), 3),
    *((name, HELPED, LEFT, MANY) for name in IMPERFECT),
)


class Experiment(NamedTuple):
    """A figure or table of the paper, and the units it needs."""

    title: str
    algorithms: tuple[str, ...]
    settings: tuple[str, ...] = (NORMAL,)
    scenarios: tuple[str, ...] = SCENARIOS


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
    "table1": Experiment("beside the human, left turn", (*GUIDED, HUMAN_MODEL), scenarios=LEFT),
    "table2": Experiment("beside the human, congestion", (*GUIDED, HUMAN_MODEL), scenarios=JAM),
    "ablation": Experiment("PHIL-TD3 without each of its parts", ("phil_td3", "ia_td3", *PARTS)),
    "time": Experiment("training time", FOUR, scenarios=LEFT),
    "printed": Experiment("the settings as the paper prints them", FOUR, (NORMAL, PRINTED)),
    "floor": Experiment("the best constant action", (CONSTANT,)),
    "goals": Experiment(
        "what this project wants of the learner",
        (*FOUR, *NO_CLONING, *TESTED_ONLY),
        (NORMAL, BIASED),
    ),
    "cost": Experiment("what a training cost, and whether it lasts", FOUR),
}
"""Name on the command line -> what it is."""


@dataclass(frozen=True)
class Plan:
    """What every unit has in common."""

    steps: Mapping[str, int]
    """Scenario -> environment steps of a training, the same for every algorithm."""
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
    """Task -> fields of the plan that are others in it, since its steps take long."""

    def of(self, scenario: str) -> Plan:
        """The plan for one task."""
        return replace(self, **self.slow.get(scenario, {}))


PLAN = Plan(steps={"left_turn": 6_000, "congestion": 6_000})
QUICK = Plan(
    steps={"left_turn": 250, "congestion": 250},
    evaluate_every_steps=100,
    evaluation_runs=2,
    test_runs=3,
    together=3,
    checkpoint_every=1,
    search_runs=2,
    search_points=3,
    learner={"batch_size": 4, "warmup_steps": 16},
)
"""A look at everything in a minute or two; its numbers mean nothing."""
GUIDANCE_PLAN = Plan(
    steps={**dict.fromkeys(SCENARIOS, 4_000), "hill": 4_000, "racetrack": 12_000},
    evaluate_every_steps=250,
    test_runs=100,
    slow={"racetrack": {"evaluate_every_steps": 1_000, "evaluation_runs": 20, "test_runs": 50}},
)
QUICK_GUIDANCE = replace(QUICK, steps=dict.fromkeys((*SCENARIOS, *FOREIGN), 250))
UNLIMITED_EPISODES = 10**6  # So many that steps decide
PAPER_TESTS = 50
"""Of the test drives in a scene, the first so many have the paper's seeds (section VII-D)."""


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
        """Whether anything is trained for it."""
        return self.algorithm in ALGORITHMS

    @property
    def needs_human(self) -> bool:
        """Whether a human model decides its result."""
        guided = self.trained and ALGORITHMS[self.algorithm].guided
        return self.algorithm == HUMAN_MODEL or (guided and not SETTINGS[self.setting].human)

    @property
    def environment(self) -> str:
        """What the environment is made by."""
        return FOREIGN.get(self.scenario, (self.scenario, EXPERT))[0]

    @property
    def scripted_human(self) -> str:
        """Names the script that guides, or the one that the human model imitates."""
        human = SETTINGS[self.setting].human
        if ":" in human:
            return human
        return FOREIGN.get(self.scenario, (self.scenario, EXPERT))[1]

    @property
    def conditions(self) -> tuple[str, ...]:
        """Those under which it is tested."""
        return ("nominal", "noise") if self.scenario in FOREIGN else tuple(CONDITIONS)


def units_of(names: Collection[str], seeds: int, scenario: str | None = None) -> list[Unit]:
    """The units of some experiments, or of ``all`` of the paper's, each once, in the order of work.

    Seed by seed within a line, so that work that stops early leaves balanced results.
    """
    lines = GUIDANCE_LINES if GUIDANCE in names else LINES
    units = [
        Unit(where, algorithm, setting, seed)
        for setting, algorithms, tasks, most in lines
        for seed in (range(1, min(seeds, most) + 1) if most else [0])
        for where, algorithm in product(tasks, algorithms)
        if scenario in (None, where)
    ]
    if {"all", GUIDANCE} & set(names):
        return units
    chosen = (EXPERIMENTS[name] for name in names)
    wanted = {
        what for one in chosen for what in product(one.scenarios, one.algorithms, one.settings)
    }
    return [unit for unit in units if unit[:3] in wanted]


def run_config(unit: Unit, plan: Plan, humans: Path) -> RunConfig:
    """The settings of a unit's training."""
    setting, plan = SETTINGS[unit.setting], plan.of(unit.scenario)
    start = PRESETS[setting.preset]
    return replace(
        start,
        scenario=unit.environment,
        algorithm=unit.algorithm,
        seed=unit.seed,
        episodes=UNLIMITED_EPISODES,
        steps=plan.steps[unit.scenario],
        human=str(humans / unit.scenario) if unit.needs_human else unit.scripted_human,
        evaluate_every_steps=plan.evaluate_every_steps,
        evaluation_runs=plan.evaluation_runs,
        checkpoint_every=plan.checkpoint_every,
        threads=1,
        learner=replace(
            start.learner,
            **{
                **ALGORITHMS[unit.algorithm].settings,
                **(TUNED.get(unit.algorithm, {}) if unit.setting in HUMANS else {}),
                **plan.learner,
                **setting.learner,
            },
        ),
        **setting.run,
    )


ID_LENGTH = 12
NOT_DECIDING = ("device", "threads", "checkpoint_every", "human")
"""Fields of a run's config that do not decide its result; the human model's contents do."""


def decided(values: Mapping[str, Any], default: Any, left_out: Collection[str]) -> dict[str, Any]:
    """The fields of a config or a row that decide, with ``default`` as the dataclass makes it.

    Later ones at their default are left out of the id, so that older records keep theirs.
    """
    return {
        name: decided(value, default.learner, ()) if name == "learner" else value
        for name, value in values.items()
        if name not in left_out and not (name in LATER and value == getattr(default, name))
    }


def is_possible(unit: Unit, humans: Path) -> bool:
    """Whether the human model that it needs, if it does, is there."""
    return not unit.needs_human or (humans / unit.scenario / MODEL_FILE).is_file()


def deciding(unit: Unit, plan: Plan, humans: Path) -> dict[str, Any]:
    """What decides a unit's training, as plain values."""
    values: dict[str, Any] = {"unit": unit._asdict(), "human": None}
    scene = unit.environment, "nominal", unit.scripted_human
    if unit.needs_human:
        model = read_bytes(humans / unit.scenario / MODEL_FILE, "human model")
        values["human"] = hashlib.sha256(model).hexdigest()[:ID_LENGTH]
    if unit.trained:
        config = run_config(unit, plan, humans)
        values["config"] = decided(asdict(config), RunConfig(), NOT_DECIDING)
        # The row's hyper-parameters are in the config.
        switches = asdict(ALGORITHMS[unit.algorithm])
        values["switches"] = decided(switches, Algorithm(), ["settings"])
        values["scene"] = behaviour(*scene, config.printed_reward)
    if unit.algorithm == CONSTANT:
        values["search"] = [plan.search_runs, plan.search_points]
    if unit.algorithm in (CONSTANT, EXPERT):
        values["scene"] = behaviour(*scene)
    return values


def testing(unit: Unit, plan: Plan) -> dict[str, Any]:
    """What decides a unit's tests, beside its training."""
    where, human = unit.environment, unit.scripted_human
    scenes = {name: behaviour(where, name, human) for name in unit.conditions}
    return {"runs": plan.of(unit.scenario).test_runs, "noise_std": COMMAND_NOISE, "scenes": scenes}


def digest(values: Mapping[str, Any]) -> str:
    """Hash of plain values, whatever the order in which they stand."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_LENGTH]


@cache
def behaviour(
    scenario: str, condition: str, human: str = EXPERT, printed_reward: bool = False
) -> str:
    """Hash of what a scene does: pictures, rewards and the human's take-overs in three drives.

    It notices a changed line of code, which a hash of configs would miss, and ignores what changes
    nothing. Numbers are rounded, since libraries differ in their last bits.
    """
    env = make_environment(scenario, condition, printed_reward)
    held = steps_held(env.control_period_s)
    guide = HumanGuide(expert_of(env, human), expert_of(env, human), held)
    seen = hashlib.sha256()
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        guide.reset()
        random, ended = np.random.default_rng(seed), False
        while not ended:
            policy = random.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
            intervention = guide.watch(observation, policy)
            action = policy if intervention is None else intervention.action
            observation, reward, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            if observation.dtype.kind == "f":
                observation = observation.round(6) + 0.0
            seen.update(observation.tobytes())
            numbers = [reward, info["distance_m"], *map(float, action)]
            why = None if intervention is None else (intervention.reason, intervention.first)
            seen.update(repr(([round(number, 6) + 0.0 for number in numbers], why)).encode())
        seen.update(str(info["outcome"]).encode())
    return seen.hexdigest()[:ID_LENGTH]
