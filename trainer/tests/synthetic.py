"""Outcomes out of the air, for figures and verdicts: how an algorithm of some skill would do."""

from collections.abc import Iterable

import numpy as np

from edge_runtime.episode_report import COLLISION, GOAL
from trainer.experiments.gathered import Gathered
from trainer.experiments.outcome import Drives, Outcome
from trainer.experiments.plan import FULL_PATH_M
from trainer.experiments.units import Unit

CONDITIONS = ("nominal", "noise", "variant")
SKILLS = {
    "phil_td3": 0.99, "ia_td3": 0.9, "hi_td3": 0.8, "per_td3": 0.3, "human_model": 0.93,
    "phil_td_only": 0.85, "phil_q_advantage_only": 0.9, "phil_advantage_0.1": 0.88,
    "phil_advantage_100": 0.97, "rd2_td3": 0.7, "rd2_phil": 0.9, "phil_without_cloning": 0.8,
    "phil_without_shaping": 0.9,
}  # fmt: skip
FACTORS = {
    "normal": 1.0,
    "tough": 0.85,
    "poor": 0.97,
    "remedy": 1.0,
    "exact_losses": 0.9,
    "importance": 0.9,
    "weak_cloning": 0.9,
    "printed_rates": 0.9,
    "printed_reward": 0.5,
    "last_actor": 0.95,
    "network": 0.95,
}


def outcome(unit: Unit, episodes: int = 100, runs: int = 50, conditions=CONDITIONS) -> Outcome:
    """Learns to its skill within its first episodes, the more skilled the sooner."""
    skill = SKILLS[unit.algorithm] * FACTORS[unit.setting]
    random = np.random.default_rng([unit.seed, *unit.algorithm.encode(), *unit.setting.encode()])
    full_m = FULL_PATH_M[unit.scenario]
    metrics = {}
    if unit.trained:
        learned = skill * (1.0 - np.exp(-np.arange(episodes) * skill / 15))
        noise = random.normal(0.0, 0.04, episodes) + random.normal(0.0, 0.01)
        success = np.full(episodes, np.nan)
        success[9::10] = np.clip(learned[9::10], 0.0, 1.0)
        metrics = {
            "episode_return": 20.0 * (learned + noise) - 10.0,
            "distance_m": full_m * np.clip(learned + noise, 0.0, 1.0),
            "validation_success": success,
            "validation_distance_m": full_m * success,
            "validation_reward": 20.0 * success - 10.0,
        }
    tests = {}
    for place, condition in enumerate(conditions):
        reached = random.random(runs) < skill - 0.03 * place
        tests[condition] = Drives(
            {
                "seed": list(range(runs)),
                "outcome": [GOAL if arrived else COLLISION for arrived in reached],
                "distance_m": np.where(reached, full_m, full_m * random.random(runs)),
                "time_s": 9.0 - 2.0 * skill + random.normal(0.0, 0.3, runs),
                "reward": np.where(reached, 10.0, -10.0),
                "lateral_acceleration_mps2": 1.5 - skill + random.gamma(2.0, 0.1, runs),
                "longitudinal_acceleration_mps2": 2.0 - skill + random.gamma(2.0, 0.1, runs),
            }
        )
    return Outcome(unit, metrics, tests)


def gathered(units: Iterable[Unit], seeds: int, without: Iterable[Unit] = ()) -> Gathered:
    """All units but some."""
    wanted, left_out = list(units), set(without)
    return Gathered(wanted, {u: outcome(u) for u in wanted if u not in left_out}, seeds)
