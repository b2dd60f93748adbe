"""Both scenarios through a separate edge runtime: against the same drive in process, behind a bad
network, with a runtime that is killed, with a vehicle; and the recorded drive of the last release.
"""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from bridge.__main__ import main as bridge
from bridge.network import parse_spec
from bridge.tests.harness import read, simulate_undisturbed, start_simulate, wait_until_driving
from edge_runtime.cli import run_cli
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.tests.policies import write_policy as write_toy_policy
from hil_tests.processes import POLICY, PUBLIC_KEY, Process
from hil_tests.recording import LEFT_TURN
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


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    return {scenario: untrained(folder, scenario) for scenario in ("left_turn", "congestion")}


@pytest.fixture(scope="module")
def policy(policies):
    return policies["left_turn"]


def edge(endpoint: str, policy: Path) -> EdgeProcess:
    return EdgeProcess("--policy", str(policy), "--connect", endpoint, "--allow-unsigned")


@pytest.mark.parametrize(
    ("scenario", "condition", "episodes"),
    [("left_turn", "nominal", 4), ("congestion", "nominal", 2), ("congestion", "variant", 2)],
)
def test_lock_step_over_the_wire_is_the_drive_in_process(
    policies, tmp_path, scenario, condition, episodes
):
    policy = policies[scenario]
    env = make_environment(scenario, condition)
    wanted = drive_episodes(env, OnnxDriver(policy), range(episodes), condition)
    endpoint = free_endpoint()
    options = ["--episodes", str(episodes), "--condition", condition]
    with edge(endpoint, policy):
        report = simulate_undisturbed(tmp_path, endpoint, scenario, options)
    assert (report["scenario"], report["condition"]) == (scenario, condition)
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
    with Process("edge_runtime", "run", *arguments, "--vehicle", "mock", ready="ready"):
        options = ("--episodes", "2", "--clock", "lockstep", "--latency", "50ms+-10ms")
        with start_simulate(endpoint, out, "left_turn", *options) as simulator:
            assert simulator.wait(120) == 0, simulator.errors
    latency_ms = read(out)["latency_ms"]
    assert 80 < latency_ms["p50"] < 125
    assert latency_ms["max"] > latency_ms["p50"] + 10


@pytest.fixture(scope="module")
def shipped():
    """Where an edge runtime with the shipped policy waits for a simulator."""
    where = free_endpoint()
    with edge(where, ROOT / POLICY):
        yield where


def drive(endpoint, spec, folder):
    return simulate_undisturbed(
        folder, endpoint, "left_turn", ["--episodes", "3", "--latency", spec]
    )


@pytest.mark.parametrize("spec", [LATE, BAD])
def test_training_and_lock_step_over_zenoh_are_the_same_drive_to_the_bit(shipped, spec, tmp_path):
    """What is trained behind a network is what drives behind it."""
    env = make_environment("left_turn")
    trained = drive_episodes(env, OnnxDriver(POLICY), range(3), latency=parse_spec(spec))
    report = drive(shipped, spec, tmp_path)
    assert bool(report["safe_stops"]) == (spec == BAD)
    for ours, theirs in zip(report["per_episode"], trained, strict=True):
        assert ours["actions"] == theirs.actions
        assert (ours["outcome"], ours["distance_m"]) == (theirs.outcome, theirs.distance_m)


def test_virtual_time_repeats_itself_to_the_bit(shipped, tmp_path):
    first, again = (drive(shipped, BAD, tmp_path) for _ in range(2))
    assert first["per_episode"] == again["per_episode"]
    assert first["deadline_misses"] == again["deadline_misses"] > 0


def replay(out, *options):
    status = run_cli(bridge, ["replay", str(LEFT_TURN), "--out", str(out), *options])
    return status, json.loads(out.read_text())


def test_every_recorded_command_is_still_the_same(tmp_path):
    trust = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
    status, report = replay(tmp_path / "r.json", *trust)
    assert report["recorded_policy_ids"] == [report["policy_id"]], "another policy: make recording"
    assert status == 0, report["first_differences"]
    assert report["compared"] > 200
    # Not only the driving: the simulator was stopped in the middle.
    assert report["by_recorded"]["safe_stop: no_fresh_state"]["compared"] >= 5
    assert report["different"] == report["dropped"] == 0


def test_another_policy_is_found_out(tmp_path):
    other = tmp_path / "other.onnx"
    write_toy_policy(other, "mean")
    status, report = replay(tmp_path / "r.json", "--policy", str(other), "--allow-unsigned")
    assert status == 1
    assert report["by_recorded"]["drive"]["different"] > 100
    assert report["largest_difference"] > 0.1
