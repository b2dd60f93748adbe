import json
from pathlib import Path
from types import SimpleNamespace

import av
import msgspec
import numpy as np
import pytest
import torch

from edge_runtime.cli import run_cli
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import refusal
from trainer.__main__ import main
from trainer.environments import make_environment
from trainer.evaluation import (
    BEST_FILE,
    OnnxDriver,
    TogetherDriver,
    drive_episodes,
    drive_together,
    evaluate,
    load_actor,
)
from trainer.learner.networks import Actor
from trainer.tests.odd import odd
from trainer.util import save_torch

POLICY = Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx"


@pytest.mark.parametrize(
    "crafted",
    [
        {"seed": torch.zeros(2)},
        {"kept_actor": []},
        {"actor": {"head.output.bias": torch.zeros(1), "picture.conv1.weight": torch.zeros(0)}},
    ],
)
def test_a_crafted_field_of_a_checkpoint_is_one_line(tmp_path, crafted):
    label = {"scenario": "left_turn", "algorithm": "phil_td3", "seed": 0, "episode": 3}
    save_torch(tmp_path / BEST_FILE, {**label, "actor": Actor().state_dict(), **crafted})
    with pytest.raises(UserError):
        load_actor(tmp_path, make_environment("left_turn"))


@pytest.mark.parametrize("command", ["evaluate", "export"])
def test_a_run_in_a_modules_environment_is_taken_where_that_is_typed(tmp_path, capsys, command):
    """Nothing is imported because a file says so, and the line says what to type."""
    planted = "trainer.tests.planted:Env-v0"  # Not there: importing it would be another line.
    label = {"scenario": planted, "algorithm": "phil_td3", "seed": 0, "episode": 3}
    save_torch(tmp_path / BEST_FILE, {**label, "actor": Actor().state_dict()})
    (tmp_path / "config.json").write_text(json.dumps({"scenario": planted}))
    words = [command, str(tmp_path), "--out", str(tmp_path / "out.onnx")]
    for more, says in (([], f"give --scenario {planted}"), (["--scenario", planted], "no module")):
        assert run_cli(main, [*words, *more]) == 2
        assert says.lower() in capsys.readouterr().err.lower()
        assert not (tmp_path / "out.onnx").exists()


def test_a_policy_file_changes_as_fast_as_the_edge_lets_it(monkeypatch):
    policy = load_policy(POLICY, allow_unsigned=True)
    (row,) = policy.manifest.action
    slow = msgspec.structs.replace(row, slew_per_s=0.5)
    manifest = msgspec.structs.replace(policy.manifest, action=[slow])
    session = SimpleNamespace(run=lambda outputs, inputs: [np.ones((1, 1), np.float32)])
    policy = policy._replace(manifest=manifest, session=session)
    monkeypatch.setattr("trainer.evaluation.load_policy", lambda *_, **__: policy)
    driver, seen = OnnxDriver(POLICY), np.zeros((2, 45, 80), np.uint8)
    for _ in range(2):
        driver.reset()
        np.testing.assert_allclose([driver.act(seen)[0] for _ in range(3)], [0.05, 0.1, 0.15])


@TogetherDriver
def brightness(observations):
    """Its action follows the newer picture."""
    means = observations.mean(axis=(2, 3), dtype=np.float64) / 255.0
    return np.tanh(3.0 * (means[:, 1:] - 0.25)).astype(np.float32)


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_side_by_side_is_one_after_the_other(scenario):
    env, seeds, driven = make_environment(scenario), range(5), []
    for condition in ("nominal", "noise"):
        wanted = drive_episodes(env, brightness, seeds, condition)
        for lanes in (3, 8):  # Fewer than episodes, and more.
            envs = [make_environment(scenario) for _ in range(lanes)]
            assert drive_together(envs, brightness.act_together, seeds, condition) == wanted
            assert drive_together(envs, brightness.act_together, [], condition) == []
        driven.append(wanted)
    assert driven[0] != driven[1]


def test_an_evaluation_is_behind_its_network():
    (alone,), (late,) = (
        evaluate("constant:1", "left_turn", runs=1, latency=spec).episodes
        for spec in ("none", "300ms")
    )
    assert (alone.actions[0], late.actions[0], late.actions[-1]) == ([1.0], [0.0], [1.0])


def test_an_evaluation_is_filmed_shown_and_followed(tmp_path):
    film, shown, steps = tmp_path / "films/drive.mp4", tmp_path / "drive.rrd", []
    found = evaluate(
        "constant:1", "left_turn", runs=2, seed=3, video=film, rerun=str(shown),
        on_step=lambda seen, _, info: steps.append((seen, info)),
    )  # fmt: skip
    lengths = [episode.steps for episode in found.episodes]
    assert len(steps) == sum(lengths)
    assert [info["outcome"] for seen, info in steps if seen.terminal] == ["collision"] * 2
    assert all((seen.action == 1).all() for seen, _ in steps)
    with av.open(str(film)) as pictures:
        assert pictures.streams.video[0].average_rate == 10
        # Each end is held for a second.
        assert len(list(pictures.decode(video=0))) == sum(lengths) + 2 * 9
    assert shown.stat().st_size > 10_000
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["drive.mp4", "drive.rrd", "films"]
    low, high = found.report["success_interval"]
    assert low == found.success_rate == 0.0
    assert 0.5 < high < 0.8


def test_what_cannot_be_filmed_or_shown_is_refused_and_leaves_nothing(tmp_path, capsys):
    other = ("--scenario", odd("Tells"), "--video")
    for words in (("--video", "a.avi"), (*other, "a.mp4"), ("--rerun", "a.txt")):
        placed = [str(tmp_path / word) if word.startswith("a.") else word for word in words]
        refusal(capsys, "evaluate", "constant:1", "--runs", "1", *placed)
    assert list(tmp_path.iterdir()) == []
