"""What is trained behind a network is what drives behind it: in process against the real loop."""

from pathlib import Path

import pytest

from bridge.tests.processes import simulate_undisturbed
from edge_runtime.latency.model import parse_spec
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.transport import free_endpoint
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import drive_episodes

POLICY = Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx"
EPISODES = 3
LATE = "100ms"
BAD = "60ms+-40ms,loss=10%,burst=3,duplicate=5%,reorder=5%,outage=0.6s/2s,rate=1Mbit/s"


@pytest.fixture(scope="module")
def endpoint():
    where = free_endpoint()
    with EdgeProcess("--policy", str(POLICY), "--connect", where, "--allow-unsigned"):
        yield where


def drive(endpoint, spec, folder):
    options = ["--episodes", str(EPISODES), "--latency", spec]
    return simulate_undisturbed(folder, endpoint, "left_turn", options)


@pytest.mark.parametrize("spec", [LATE, BAD])
def test_training_and_lock_step_over_zenoh_are_the_same_drive_to_the_bit(endpoint, spec, tmp_path):
    env = make_environment("left_turn")
    trained = drive_episodes(env, OnnxDriver(POLICY), range(EPISODES), latency=parse_spec(spec))
    report = drive(endpoint, spec, tmp_path)
    assert bool(report["safe_stops"]) == (spec == BAD)
    for ours, theirs in zip(report["per_episode"], trained, strict=True):
        assert ours["actions"] == theirs.actions
        assert (ours["outcome"], ours["distance_m"]) == (theirs.outcome, theirs.distance_m)


def test_virtual_time_repeats_itself_to_the_bit(endpoint, tmp_path):
    first, again = (drive(endpoint, BAD, tmp_path) for _ in range(2))
    assert first["per_episode"] == again["per_episode"]
    assert first["deadline_misses"] == again["deadline_misses"] > 0
