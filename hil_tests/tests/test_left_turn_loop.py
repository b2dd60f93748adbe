"""The left turn through a separate edge runtime, against the same drive in process."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from bridge.tests.processes import (
    read,
    simulate_undisturbed,
    start_simulate,
    wait_until_driving,
)
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.transport import free_endpoint
from hil_tests.commands import BackgroundCommand
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import drive_episodes
from trainer.export import export_policy, write_policy
from trainer.learner.networks import Actor

EPISODES = 4
LABEL = {"scenario": "left_turn", "algorithm": "phil_td3", "seed": 0, "episode": 0}


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """An untrained actor that creeps forward, exported for real."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        actor = Actor()
    with torch.no_grad():
        actor.head.output.weight.mul_(10)
        actor.head.output.bias.add_(0.2)
    path = tmp_path_factory.mktemp("policy") / "policy.onnx"
    write_policy(export_policy(actor, LABEL, {}), path, None)
    return path


def edge(endpoint: str, policy: Path, *options: str) -> EdgeProcess:
    arguments = ("--policy", str(policy), "--connect", endpoint, "--allow-unsigned")
    return EdgeProcess(*arguments, *options)


def test_lock_step_over_the_wire_is_the_drive_in_process(policy, tmp_path):
    env = make_environment("left_turn")
    wanted = drive_episodes(env, OnnxDriver(policy), range(EPISODES))
    endpoint = free_endpoint()
    runtime = edge(endpoint, policy)
    try:
        report = simulate_undisturbed(tmp_path, endpoint, "left_turn", ["--episodes", "4"])
    finally:
        runtime.end()
    assert report["safe_stops"] == 0
    for ours, theirs in zip(report["per_episode"], wanted, strict=True):
        assert (ours["seed"], ours["outcome"]) == (theirs.seed, theirs.outcome)
        np.testing.assert_allclose(ours["actions"], theirs.actions, atol=1e-5)
        assert ours["distance_m"] == pytest.approx(theirs.distance_m, abs=1e-4)


def kill_and_restart(policy: Path, out: Path) -> dict:
    """Drive one episode whose edge runtime is killed and started again; return the report."""
    endpoint = free_endpoint()
    options = ("--episodes", "1", "--clock", "realtime", "--seed", "3")
    with start_simulate(endpoint, out, "left_turn", *options) as simulator:
        with edge(endpoint, policy) as runtime:
            wait_until_driving(runtime)
            time.sleep(0.5)
            runtime.process.send_signal(signal.SIGKILL)
            runtime.process.wait()
        time.sleep(1.0)
        with edge(endpoint, policy):
            assert simulator.wait(60) == 0, simulator.errors
    return read(out)


def test_a_killed_runtime_stops_the_car_and_a_new_one_drives_on(policy, tmp_path):
    for attempt in range(3):
        report = kill_and_restart(policy, tmp_path / f"kill{attempt}.json")
        if report["tick_overruns"] == 0:  # Otherwise the machine stalled: its times mean nothing.
            break
    event = next(row for row in report["safe_stop_events"] if row["reason"] == "no_command")
    assert event["brake_after_s"] <= 0.3  # 2 T and a tick
    assert event["stopped_after_s"] is not None or event["resumed_after_s"] is not None
    applied = np.array(report["per_episode"][0]["actions"])[:, 0]
    braking = np.flatnonzero(applied == -1.0)
    assert len(braking) >= 5
    assert (applied[braking[-1] + 1 :] > -1.0).any()


def test_a_mock_vehicle_drives_along_and_latency_is_really_there(policy, tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "late.json"
    arguments = ("--policy", str(policy), "--connect", endpoint, "--allow-unsigned")
    with BackgroundCommand("edge_runtime", "run", *arguments, "--vehicle", "mock", ready="ready"):
        options = ("--episodes", "2", "--clock", "lockstep", "--latency", "50ms+-10ms")
        with start_simulate(endpoint, out, "left_turn", *options) as simulator:
            assert simulator.wait(120) == 0, simulator.errors
    latency_ms = read(out)["latency_ms"]
    assert 80 < latency_ms["p50"] < 125
    assert latency_ms["max"] > latency_ms["p50"] + 10
