from __future__ import annotations

import json

import pytest

from edge_runtime.episode_report import EpisodeResult, summarise


def episode(outcome, distance_m):
    return EpisodeResult(
        seed=1, outcome=outcome, distance_m=distance_m, reward=2.0, time_s=3.0,
        lateral_acceleration_mps2=0.0, longitudinal_acceleration_mps2=1.0, steps=30,
    )  # fmt: skip


def test_summarise_by_hand():
    report = summarise(
        [episode("goal", 10.0), episode("collision", 20.0)], "left_turn", "nominal", "id", 7
    )
    assert report["success_rate"] == report["collision_rate"] == 0.5
    assert report["surviving_distance_m"] == {"mean": 15.0, "std": 5.0}
    assert set(report) == {
        "scenario", "condition", "episodes", "success_rate", "collision_rate",
        "surviving_distance_m", "episode_reward", "episode_time_s", "lateral_acceleration_mps2",
        "longitudinal_acceleration_mps2", "policy_id", "seed",
    }  # fmt: skip
    json.dumps(report, allow_nan=False)
    with pytest.raises(ValueError, match="no episode"):
        summarise([], "left_turn", "nominal", "id", 7)
