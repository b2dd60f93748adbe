"""A tiny plan, stores in a directory, and records out of the air for figures and verdicts."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bridge.outcomes import COLLISION, GOAL
from trainer.evaluation import CONDITIONS
from trainer.experiments.data import Result, Results
from trainer.experiments.plan import (
    CONSTANT,
    EXPERT,
    FULL_PATH_M,
    HUMAN_MODEL,
    QUICK,
    SCENARIOS,
    Unit,
)
from trainer.experiments.run import Store
from trainer.human.config import MODEL_FILE, HumanModelConfig
from trainer.human.model import HumanModel

TINY = replace(
    QUICK, steps=dict.fromkeys(SCENARIOS, 290), learner={"batch_size": 4, "warmup_steps": 240}
)
UNIT = Unit("left_turn", "per_td3", "normal", 1)
"""No human guides it."""
SKILLS = {
    "phil_td3": 0.99, "ia_td3": 0.9, "hi_td3": 0.8, "per_td3": 0.4, HUMAN_MODEL: 0.93,
    "phil_td_only": 0.85, "phil_q_advantage_only": 0.9, "phil_advantage_0.1": 0.88,
    "phil_advantage_100": 0.97, "rd2_td3": 0.7, "rd2_phil": 0.92, "phil_without_cloning": 0.8,
    "phil_without_shaping": 0.9, CONSTANT: 0.3, EXPERT: 1.0,
}  # fmt: skip
FACTORS = {
    "normal": 1.0, "one_frame": 0.85, "random": 0.97, "biased": 0.9, "printed": 0.5
}  # fmt: skip
BUDGET = 6_000


def store_in(directory: Path, plan: Any = TINY) -> Store:
    return Store(plan, directory / "results", directory / "runs", directory / "humans")


def write_human(store: Store, scenario: str = "left_turn", seed: int = 1) -> Path:
    """An untrained one."""
    directory = store.humans / scenario
    directory.mkdir(parents=True, exist_ok=True)
    HumanModel(HumanModelConfig(), seed).save(directory, {"scenario": scenario})
    return directory / MODEL_FILE


class Soon(float):
    """A time that is still to come when it is first looked at, and over ever after."""

    looked = False

    def __lt__(self, other: float) -> bool:
        looked, self.looked = self.looked, True
        return looked


def without_times(store: Store, unit: Unit) -> dict[str, Any]:
    """What must be the same in a unit's record however often it was stopped."""
    record = store.find([unit])[0][unit]
    return {name: value for name, value in record.items() if name != "computed"}


def synthetic(unit: Unit, runs: int = 60) -> dict[str, Any]:
    """The record of a unit that learns to its skill, the more skilled the sooner."""
    skill = SKILLS[unit.algorithm] * FACTORS.get(unit.setting, 1.0)
    random = np.random.default_rng([unit.seed, *"".join(unit[:3]).encode()])
    full_m = FULL_PATH_M[unit.scenario]
    tests = {}
    for place, condition in enumerate(CONDITIONS):
        reached = random.random(runs) < skill - 0.03 * place
        tests[condition] = {
            "outcome": [GOAL if arrived else COLLISION for arrived in reached],
            "distance_m": np.where(reached, full_m + 0.2, full_m * random.random(runs)).tolist(),
            "time_s": (9.0 - 2.0 * skill + random.normal(0.0, 0.3, runs)).tolist(),
            "reward": np.where(reached, 10.0, -10.0).tolist(),
            "lateral_acceleration_mps2": (1.5 - skill + random.gamma(2.0, 0.1, runs)).tolist(),
            "longitudinal_acceleration_mps2": (2 - skill + random.gamma(2.0, 0.1, runs)).tolist(),
        }
    computed = {"training_s": 300 + unit.seed}
    record = {"id": "", "unit": unit._asdict(), "tests": tests, "computed": computed}
    if unit.algorithm == CONSTANT:
        return {**record, "action": 0.1, "success_of": {"0": 0.2, "0.1": 0.3}, "search": [2, 2]}
    if not unit.trained:
        return record
    ends = np.arange(60, BUDGET + 60, 60)
    learned = skill * (1.0 - np.exp(-ends * skill / 900.0)) + random.normal(0.0, 0.01)
    reached = random.random(len(ends)) < learned
    at_step = np.arange(500, BUDGET + 1, 500) + 20
    success = np.clip(np.interp(at_step, ends, learned), 0.0, 1.0)
    return {
        **record,
        "config": {"steps": BUDGET, "evaluate_every_steps": 500},
        "training": {
            "end_step": ends.tolist(),
            "return": (20.0 * learned - 10.0).tolist(),
            "distance_m": (full_m * np.clip(learned, 0.0, 1.0)).tolist(),
            "outcome": [GOAL if arrived else COLLISION for arrived in reached],
            "human_steps": [3] * len(ends),
            "takeovers": [1] * len(ends),
        },
        "validation": {
            "at_step": at_step.tolist(),
            "success": success.tolist(),
            "distance_m": (full_m * success).tolist(),
            "reward": (20.0 * success - 10.0).tolist(),
        },
        "totals": {"steps": BUDGET, "updates": BUDGET},
    }


def results_of(units: Iterable[Unit], seeds: int) -> Results:
    return Results({unit: Result(unit, synthetic(unit)) for unit in units}, seeds)
