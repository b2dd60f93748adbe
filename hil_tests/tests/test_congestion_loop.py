"""The congestion through a separate edge runtime: the same drive as in process, in both scenes."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bridge.tests.processes import simulate_undisturbed
from edge_runtime.tests.harness import EdgeProcess
from edge_runtime.transport import free_endpoint
from trainer.drivers import OnnxDriver, make_environment
from trainer.evaluate import drive_episodes
from trainer.export import export_policy, write_policy
from trainer.learner.networks import Actor

LABEL = {"scenario": "congestion", "algorithm": "phil_td3", "seed": 0, "episode": 0}


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """An untrained actor that hardly steers, exported for real."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        actor = Actor()
    path = tmp_path_factory.mktemp("policy") / "congestion.onnx"
    write_policy(export_policy(actor, LABEL, {}), path, None)
    return path


@pytest.mark.parametrize("condition", ["nominal", "variant"])
def test_lock_step_over_the_wire_is_the_drive_in_process(policy, tmp_path, condition):
    env = make_environment("congestion", condition)
    wanted = drive_episodes(env, OnnxDriver(policy), range(2), condition)
    endpoint = free_endpoint()
    arguments = ("--policy", str(policy), "--connect", endpoint, "--allow-unsigned")
    options = ["--episodes", "2", "--condition", condition]
    with EdgeProcess(*arguments):
        report = simulate_undisturbed(tmp_path, endpoint, "congestion", options)
    assert (report["scenario"], report["condition"]) == ("congestion", condition)
    assert report["safe_stops"] == 0
    for ours, theirs in zip(report["per_episode"], wanted, strict=True):
        assert (ours["seed"], ours["outcome"]) == (theirs.seed, theirs.outcome)
        np.testing.assert_allclose(ours["actions"], theirs.actions, atol=1e-5)
        assert ours["distance_m"] == pytest.approx(theirs.distance_m, abs=1e-4)
