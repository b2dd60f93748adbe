"""The result of driving episodes, the same in process (trainer) and over the wire (bridge).

Pure: numbers in, a dict with the contract's keys out (section 2).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Dict, List, Sequence

import numpy as np

GOAL = "goal"
COLLISION = "collision"
OUTCOMES = (GOAL, COLLISION, "timeout", "off_road")


@dataclass
class EpisodeResult:
    """One driven episode.

    `outcome` is one of OUTCOMES for this repository's environments; another environment may
    report its own word. Accelerations are the mean of |a| over the episode's steps. `actions`
    holds one action (a list of floats in [-1, 1]) for each step.
    """

    seed: int
    outcome: str
    distance_m: float
    reward: float
    time_s: float
    lateral_acceleration_mps2: float
    longitudinal_acceleration_mps2: float
    steps: int
    actions: List[List[float]] = field(default_factory=list)

    def as_dict(self) -> Dict[str, Any]:
        """The row of `per_episode` in a report."""
        return asdict(self)


def summarise(
    results: Sequence[EpisodeResult], scenario: str, condition: str, policy_id: str, seed: int
) -> Dict[str, Any]:
    """The contract's summary of `results`. `std` is over the episodes (population, ddof 0).

    Raises ValueError for no episode at all: a mean of nothing is no number.
    """
    if not results:
        raise ValueError("no episode to summarise")
    return {
        "scenario": scenario,
        "condition": condition,
        "episodes": len(results),
        "success_rate": _rate(results, GOAL),
        "collision_rate": _rate(results, COLLISION),
        "surviving_distance_m": _spread([r.distance_m for r in results]),
        "episode_reward": _spread([r.reward for r in results]),
        "episode_time_s": _spread([r.time_s for r in results]),
        "lateral_acceleration_mps2": _spread([r.lateral_acceleration_mps2 for r in results]),
        "longitudinal_acceleration_mps2": _spread(
            [r.longitudinal_acceleration_mps2 for r in results]
        ),
        "policy_id": policy_id,
        "seed": seed,
    }


def _rate(results: Sequence[EpisodeResult], outcome: str) -> float:
    return sum(result.outcome == outcome for result in results) / len(results)


def _spread(values: Sequence[float]) -> Dict[str, float]:
    return {"mean": float(np.mean(values)), "std": float(np.std(values))}
