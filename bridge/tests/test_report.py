"""What ``bridge simulate`` says to a person: a line an episode, and the last line."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import pytest

from bridge.report import (
    EpisodeResult,
    SafeStopEvent,
    episode_line,
    make_report,
    markdown_table,
    summarise,
    summary_line,
)
from bridge.tests.harness import (
    SHORT_TOY,
    SLOW_TOY,
    make_policy,
    start_edge,
    start_simulate,
    wait_until_driving_steadily,
)
from edge_runtime.__main__ import main as edge_main
from edge_runtime.transport import free_endpoint

RESULT = EpisodeResult(0, "goal", 21.0, 1.0, 12.3, 0.0, 0.0, 123)


def report_of(outcomes, stops=(), rejected=None):
    return make_report(
        [replace(RESULT, outcome=outcome) for outcome in outcomes],
        [SafeStopEvent(0, 3, reason, 0.2) for reason in stops],
        latencies_ms=[1.0],
        command_ages_ms=[1.0],
        facts={
            "scenario": "toy", "condition": "nominal", "policy_ids": ["p"], "seed": 0,
            "deadline_misses": 38, "rejected": rejected or {}, "wall_s": 1.0,
        },
    )  # fmt: skip


def test_every_outcome_is_named_and_every_reason():
    outcomes = ["goal", "timeout", "goal", "collision", "timeout", "timeout"]
    line = summary_line(report_of(outcomes, ["no_command", "no_command", "vehicle_fault"]))
    assert line == (
        "6 episodes: 2 goal (33%), 3 timeout (50%), 1 collision (17%); latency p50 1.0 ms,"
        " p99 1.0 ms; 3 safe stops (2 no_command, 1 vehicle_fault); 0 rejected messages"
    )


def test_a_stop_is_told_as_a_stop_and_not_as_missed_deadlines():
    line = summary_line(report_of(["timeout"], ["no_command"], {"stale": 2}))
    assert "0 goal (0%), 1 timeout (100%)" in line
    assert "1 safe stop (1 no_command); 2 rejected messages (2 stale)" in line
    assert "38" not in line


def test_a_line_an_episode():
    assert episode_line(2, 5, RESULT, []) == "episode 2 of 5: goal after 12.3 s"
    stop = SafeStopEvent(1, 3, "no\x1bcommand", 0.2)
    assert episode_line(2, 5, RESULT, [stop]).endswith("; 1 safe stop (1 no\\x1bcommand)")


def test_summarise_by_hand():
    ends = {"goal": 10.0, "collision": 20.0}.items()
    results = [replace(RESULT, outcome=outcome, distance_m=way_m) for outcome, way_m in ends]
    report = summarise(results, "left_turn", "nominal", "id", 7)
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


def test_a_table_in_markdown_keeps_its_columns():
    lines = markdown_table(["row", "p50"], [["a|b", 1], ["c", None]])
    assert list(lines) == ["| row | p50 |", "|---|---|", "| a/b | 1 |", "| c | None |", ""]


def test_without_a_terminal_each_episode_is_told_as_it_ends(tmp_path):
    policy, endpoint = make_policy(tmp_path), free_endpoint()
    options = ("--episodes", "3", "--clock", "realtime")
    with (
        start_edge(endpoint, policy),
        start_simulate(endpoint, tmp_path / "r.json", SHORT_TOY, *options) as run,
    ):
        assert run.process.stderr is not None
        first = run.process.stderr.readline()
        assert run.process.poll() is None  # It comes while the others are still driven.
        assert run.wait() == 0
    lines = [first, *run.errors.splitlines()]
    for number, line in enumerate(lines, start=1):
        assert line.startswith(f"episode {number} of 3: ")
    assert len(lines) == 3
    (last,) = run.output.splitlines()
    assert last.startswith("3 episodes: ")


def test_a_car_that_waits_for_its_rearm_says_so_at_both_ends_with_the_command(tmp_path):
    """And the command is the right one."""
    policy, endpoint, log = make_policy(tmp_path, "constant"), free_endpoint(), tmp_path / "log"
    config = tmp_path / "edge.toml"
    config.write_text("armed_at_start = false\n")
    rearm = f"python -m edge_runtime rearm --connect {endpoint} --vehicle-id hunter01"
    with (
        log.open("w") as errors,
        start_edge(endpoint, policy, "--vehicle", "mock", "--config", str(config), stderr=errors),
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY, "--clock", "realtime") as run,
    ):
        assert run.process.stderr is not None
        told = run.process.stderr.readline()
        assert told == f"the vehicle stands until it is re-armed: {rearm}\n"
        assert f"waits_for_rearm command='{rearm}'" in log.read_text()
        assert edge_main(shlex.split(rearm)[3:]) == 0
        wait_until_driving_steadily(log)
        assert log.read_text().count("waits_for_rearm") == 1
