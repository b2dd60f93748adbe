"""What is said of a drive: a line an episode, and the last line."""

from dataclasses import replace

import pytest

from bridge import report as reports
from bridge.outcomes import mean_estimate, success_estimate
from bridge.report import ProgressBar

RESULT = reports.EpisodeResult(0, "goal", 21.0, 1.0, 12.3, 0.0, None, 123)
FACTS = {"scenario": "toy", "condition": "nominal", "policy_ids": ["p"], "seed": 0}


def report_of(outcomes, stops=(), **rejected):
    results = [replace(RESULT, outcome=one, distance_m=10.0 * n) for n, one in enumerate(outcomes)]
    events = [reports.SafeStopEvent(0, 3, reason) for reason in stops]
    return reports.make_report(results, events, [1.0], FACTS | {"rejected": rejected})


def test_a_report_has_the_contracts_keys_and_lines_for_a_terminal():
    report = report_of(["collision", "goal"], ["no_command", "no_command"], stale=2)
    assert report["success_rate"] == report["collision_rate"] == 0.5
    assert report["surviving_distance_m"] == {"mean": 5.0, "std": 5.0}
    assert report["lateral_acceleration_mps2"] == {"mean": 0.0, "std": 0.0}
    assert report["longitudinal_acceleration_mps2"] == {"mean": None, "std": None}
    keys = ("episode_reward", "episode_time_s", "latency_ms", "rejected", "safe_stops")
    assert set(report) >= {"scenario", "condition", "episodes", "policy_id", "seed", *keys}
    line = reports.summary_line(report)
    for part in ("1 goal", "1 collision", "2 no_command", "2 stale", "p99 1.0 ms"):
        assert part in line
    stopped = report_of(["goal"], ["no\x1bcommand"])
    assert "no\\x1bcommand" in reports.summary_line(stopped)
    assert reports.percentiles([], p50=50) == {"p50": None}


@pytest.mark.parametrize(
    ("outcomes", "success", "settled"),
    [
        (["truncated", "goal", "truncated"], 1 / 3, ["timeout", "goal", "timeout"]),
        (["failed", "truncated", "ended"], 0.0, ["failed", "timeout", "ended"]),
        (["truncated", "stopped"], None, ["truncated", "stopped"]),
    ],
)
def test_a_limit_of_steps_is_a_timeout_where_another_episode_tells(outcomes, success, settled):
    report = report_of(outcomes)
    assert [row["outcome"] for row in report["per_episode"]] == settled
    assert report["success_rate"] == success


def test_intervals_are_wilsons_and_students():
    assert success_estimate(9, 10)[:3] == pytest.approx((0.9, 0.59585, 0.98212), abs=1e-5)
    assert success_estimate(0, 4)[:3] == pytest.approx((0.0, 0.0, 0.48990), abs=1e-5)
    assert mean_estimate([1.0, 2.0, 3.0])[:3] == pytest.approx((2.0, -0.48414, 4.48414), abs=1e-5)


def test_without_a_terminal_progress_is_a_line(capsys):
    with ProgressBar("training", 10) as bar:
        bar.advance({"return": "2.0"}, 4)
        bar.advance({"return": "3.0"}, 10)  # An episode is driven to its end.
    assert capsys.readouterr().err == "training: 14/10  return 3.0\n"
