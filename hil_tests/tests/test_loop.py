"""Both scenarios through a separate edge runtime against the same drive in process, also behind a
bad network; and the recorded drive of the last release.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from bridge.__main__ import main as bridge
from bridge.network import parse_spec
from bridge.tests.harness import simulate_undisturbed
from edge_runtime.cli import run_cli
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.transport import free_endpoint
from hil_tests.pictures import LEFT_TURN
from hil_tests.processes import POLICY, PUBLIC_KEY
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import drive_episodes
from trainer.export import export_policy, write_policy
from trainer.learner.networks import Actor

ROOT = Path(__file__).parents[2]
LATE = "100ms"
BAD = "60ms+-40ms,loss=10%,burst=3,duplicate=5%,reorder=5%,outage=0.6s/2s,rate=1Mbit/s"


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def untrained(folder: Path, scenario: str) -> Path:
    """An untrained actor, exported for real: it creeps forward, or hardly steers."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        actor = Actor()
    if scenario == "left_turn":
        with torch.no_grad():
            actor.head.output.weight.mul_(10)
            actor.head.output.bias.add_(0.2)
    label = {"scenario": scenario, "algorithm": "phil_td3", "seed": 0, "episode": 0}
    path = folder / f"{scenario}.onnx"
    write_policy(export_policy(actor, label, {}), path, None)
    return path


def drive(policy, folder, scenario, *options):
    endpoint = free_endpoint()
    with EdgeProcess("--policy", str(policy), "--connect", endpoint, "--allow-unsigned"):
        return simulate_undisturbed(folder, endpoint, scenario, options)


@pytest.mark.parametrize(
    ("scenario", "condition", "episodes"),
    [("left_turn", "nominal", 4), ("congestion", "nominal", 2), ("congestion", "variant", 2)],
)
def test_lock_step_over_the_wire_is_the_drive_in_process(tmp_path, scenario, condition, episodes):
    policy = untrained(tmp_path, scenario)
    env = make_environment(scenario, condition)
    wanted = drive_episodes(env, OnnxDriver(policy), range(episodes), condition)
    options = ("--episodes", str(episodes), "--condition", condition)
    report = drive(policy, tmp_path, scenario, *options)
    assert (report["scenario"], report["condition"]) == (scenario, condition)
    assert report["safe_stops"] == 0
    for ours, theirs in zip(report["per_episode"], wanted, strict=True):
        assert (ours["seed"], ours["outcome"]) == (theirs.seed, theirs.outcome)
        np.testing.assert_allclose(ours["actions"], theirs.actions, atol=1e-5)
        assert ours["distance_m"] == pytest.approx(theirs.distance_m, abs=1e-4)


@pytest.mark.parametrize("spec", [LATE, BAD])
def test_training_and_lock_step_over_zenoh_are_the_same_drive_to_the_bit(spec, tmp_path):
    """What is trained behind a network is what drives behind it."""
    env = make_environment("left_turn")
    trained = drive_episodes(env, OnnxDriver(POLICY), range(3), latency=parse_spec(spec))
    report = drive(POLICY, tmp_path, "left_turn", "--episodes", "3", "--latency", spec)
    assert report["deadline_misses"] > 0
    assert bool(report["safe_stops"]) == (spec == BAD)
    for ours, theirs in zip(report["per_episode"], trained, strict=True):
        assert ours["actions"] == theirs.actions
        assert (ours["outcome"], ours["distance_m"]) == (theirs.outcome, theirs.distance_m)


def test_every_recorded_command_is_still_the_same(tmp_path):
    out = tmp_path / "r.json"
    trust = ["--policy", str(POLICY), "--public-key", str(PUBLIC_KEY)]
    status = run_cli(bridge, ["replay", str(LEFT_TURN), "--out", str(out), *trust])
    report = json.loads(out.read_text())
    assert report["recorded_policy_ids"] == [report["policy_id"]], "another policy: make recording"
    assert status == 0, report["first_differences"]
    assert report["compared"] > 200
    # Not only the driving: the simulator was stopped in the middle.
    assert report["by_recorded"]["safe_stop: no_fresh_state"]["compared"] >= 5
    assert report["different"] == report["dropped"] == 0
