"""What is trained behind a network is what drives behind it: in process against the real loop."""

from pathlib import Path

import numpy as np
import pytest

from bridge.tests.processes import simulate_undisturbed
from edge_runtime.latency.model import parse_spec
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.transport import free_endpoint
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluation import drive_episodes

DRIVING = Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx"
SPECS = (
    "100ms",
    "60ms+-40ms,loss=10%,duplicate=5%",
    "loss=20%,burst=3,outage=0.6s/2s,rate=1Mbit/s",
)


@pytest.fixture(scope="module")
def endpoint():
    where = free_endpoint()
    arguments = ("--policy", str(DRIVING), "--connect", where, "--allow-unsigned")
    with EdgeProcess(*arguments):
        yield where


@pytest.mark.parametrize("spec", SPECS)
def test_training_and_lock_step_are_the_same_drive(endpoint, spec, tmp_path):
    env = make_environment("left_turn")
    wanted = drive_episodes(env, OnnxDriver(DRIVING), range(4), latency=parse_spec(spec))
    options = ["--episodes", "4", "--latency", spec]
    report = simulate_undisturbed(tmp_path, endpoint, "left_turn", options)
    for ours, theirs in zip(report["per_episode"], wanted, strict=True):
        assert ours["actions"] == theirs.actions
        assert (ours["outcome"], ours["distance_m"]) == (theirs.outcome, theirs.distance_m)
    braked = [event["brake_after_s"] for event in report["safe_stop_events"]]
    assert bool(braked) == ("outage" in spec)
    again = simulate_undisturbed(tmp_path, endpoint, "left_turn", options)
    assert again["per_episode"] == report["per_episode"]
    assert np.isfinite(report["latency_ms"]["p99"])
