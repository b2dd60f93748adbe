"""Both scenarios through an edge runtime and in process; the recorded drive of the last release."""

import json
from pathlib import Path

import pytest

from bridge.__main__ import main as bridge
from bridge.network import parse_spec
from edge_runtime.cli import run_cli
from edge_runtime.reach import free_endpoint
from hil_tests.processes import POLICY, PUBLIC_KEY
from hil_tests.tests.shared.drives import LEFT_TURN, read, start_edge
from trainer.environments import make_environment
from trainer.evaluation import OnnxDriver, drive_episodes

CONTRACT_KEYS = """
scenario condition episodes policy_id seed success_rate collision_rate surviving_distance_m
episode_reward episode_time_s lateral_acceleration_mps2 longitudinal_acceleration_mps2
latency_ms deadline_misses safe_stops rejected
"""
NONE, LATE = "none", "100ms"
BAD = "60ms+-40ms,loss=10%,burst=3,duplicate=5%,reorder=5%,outage=0.6s/2s"


def simulate_undisturbed(folder, scenario, policy, options):
    """Drive anew, both ends, where the machine itself stood still for over 2 T in the middle."""
    for attempt in range(4):
        endpoint, out = free_endpoint(), folder / f"report-{attempt}.json"
        words = ["simulate", "--env", scenario, "--listen", endpoint, "--out", str(out), *options]
        with start_edge(endpoint, policy):
            assert run_cli(bridge, words) == 0
        report = read(out)
        if not report["wall_clock_stalls"]:
            return report
    raise AssertionError(f"disturbed {attempt + 1} times: {report['safe_stop_events']}")


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])


@pytest.mark.parametrize(
    ("scenario", "condition", "spec", "runs"),
    [
        *(("left_turn", "nominal", spec, 3) for spec in (NONE, LATE, BAD)),
        ("congestion", "variant", NONE, 1),
    ],
)
def test_lock_step_is_the_drive_in_process_to_the_bit(tmp_path, scenario, condition, spec, runs):
    """What is trained behind a network is what drives behind it."""
    policy = POLICY.with_name(f"{scenario}.onnx")
    env, driver = make_environment(scenario, condition), OnnxDriver(policy)
    wanted = drive_episodes(env, driver, range(runs), condition, latency=parse_spec(spec))
    options = ("--episodes", str(runs), "--condition", condition, "--latency", spec)
    report = simulate_undisturbed(tmp_path, scenario, policy, options)
    assert (report["scenario"], report["condition"]) == (scenario, condition)
    assert set(report) >= set(CONTRACT_KEYS.split())
    assert spec != NONE or (report["rejected"], report["missed_ticks"]) == ({}, 0)
    assert (report["deadline_misses"] > 0) == (spec != NONE)
    assert (report["safe_stops"] > 0) == (spec == BAD)
    for ours, theirs in zip(report["per_episode"], wanted, strict=True):
        names = ("seed", "outcome", "distance_m", "actions")
        assert [ours[name] for name in names] == [getattr(theirs, name) for name in names]


def test_every_recorded_command_is_still_the_same(tmp_path):
    out = tmp_path / "r.json"
    trust = ["--policy", str(POLICY), "--public-key", str(PUBLIC_KEY)]
    status = run_cli(bridge, ["replay", str(LEFT_TURN), "--out", str(out), *trust])
    report = json.loads(out.read_text())
    assert report["recorded_policy_ids"] == [report["policy_id"]], "another policy: make recording"
    assert status == 0, report["first_differences"]
    assert report["compared"] > 200
    # Not only the driving: the simulator was stopped in the middle.
    assert report["by_recorded"]["safe_stop: no_fresh_state"] == 4
    assert report["different"] == 0
