import json
import shlex
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from hil_tests.tests.shared.commands import call, refusal
from hil_tests.tests.shared.policies import public_pem
from trainer.scenarios.left_turn import SCENES
from trainer.tests.odd import odd
from trainer.training.command import FINDS_NOTHING
from trainer.training.config import UNLIMITED_EPISODES, RunConfig, make_config
from trainer.training.metrics import read_metrics
from trainer.util import save_torch

POLICY = str(Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx")
CONGESTION = POLICY.replace("left_turn", "congestion")


WRONG = [
    *(f"train --out {{tmp}}/x {words}" for words in (
        "--scenario moon", "--algorithm magic", "--human {tmp}/nobody", "--max-minutes nan",
        "--resume", "--set gamma=nan", "--set late_from_s=0.3",
        "--set replay_capacity=99999999999999",
    )),
    *(f"evaluate {words}" for words in (
        "{tmp}/nothing.onnx", "{tmp}/file", "expert --runs -1", "expert --out /dev/null/r.json",
    )),
    "export {tmp} --out {tmp}/p.txt", "export {tmp}/nothing --out {tmp}/p.onnx", "plot {tmp}",
    "train --out {tmp}/file/x", "plot {tmp} --out /dev/null/p.png", "human --out {tmp}/file",
    "bench --out /dev/null/b.json",
]  # fmt: skip


TOLD = [
    ("evaluate constant:nan", "expected an action from -1 to 1"),
    ("train --out x --set batch_size=1.5", "expected a whole number, got '1.5'"),
    ("train --out x --set bach_size=4", "did you mean batch_size?"),
    ("trian", "invalid choice: 'trian'"),
    ("plot one two --out c.png", "one holds no metrics"),
    ("train --out x --seeds 3-1", "such as 1-5"),
    ("train --out x --seeds 1-1000000000000", "such as 1-5"),
    ("train --out x --seed 7 --seeds 4-5", "not allowed with"),
    ("train --out x --period 5", "period_s = 5.0 is out of range: 0.01 to 1.0"),
    ("experiment report status", "no other name"),
    ("experiment table1 --scenario congestion", "nothing to compute"),
]  # fmt: skip
"""What would be right is said, too."""


@pytest.mark.parametrize(("words", "said"), [*((words, "") for words in WRONG), *TOLD])
def test_bad_input_gets_one_line_and_status_2(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("a file")
    assert said in refusal(capsys, *shlex.split(words.format(tmp=tmp_path)))
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


@pytest.mark.parametrize("words", ["--episodes 1", "--episodes 2"])
def test_only_several_episodes_of_one_return_say_that_nothing_pays(capsys, tmp_path, words):
    task = ("--scenario", odd("Flat"), "--algorithm", "per_td3", "--set", "evaluation_runs=1")
    status, _, err = call(capsys, "train", *task, "--out", tmp_path, *words.split())
    assert status == 0
    assert err.count(FINDS_NOTHING) == (words != "--episodes 1")


def test_evaluate_reports_what_the_contract_asks_for(capsys):
    words = "evaluate expert --scenario congestion --condition variant --runs 2 --seed 5"
    status, out, _ = call(capsys, *words.split())
    assert status == 0
    report = json.loads(out)
    wanted = {"scenario": "congestion", "condition": "variant", "episodes": 2, "seed": 5,
              "success_rate": 1.0, "collision_rate": 0.0, "policy_id": "expert"}  # fmt: skip
    assert wanted.items() <= report.items()
    assert report["surviving_distance_m"]["mean"] == pytest.approx(80.2, abs=0.4)


def test_a_shipped_policy_is_verified_with_the_key_beside_it(capsys, tmp_path, monkeypatch):
    """Not with another one's, which lies in the working directory; a named key decides."""
    monkeypatch.chdir(tmp_path)
    Path("keys").mkdir()
    Path("keys/policy.pub").write_bytes(public_pem(Ed25519PrivateKey.generate()))
    status, _, err = call(capsys, "evaluate", POLICY, "--runs", "1")
    assert status == 0, err
    drive = ["drive", "--human", "web", "--policy", POLICY, "--public-key", "none.pub"]
    assert "none.pub does not exist" in refusal(capsys, *drive)
    for end in ("", ".sig"):
        shutil.copy(POLICY + end, f"p.onnx{end}")
    evaluate = ["evaluate", "p.onnx", "--runs", "2"]
    err = refusal(capsys, *evaluate)
    assert "public key keys/policy.pub: " in err
    assert "--public-key" in err
    key = str(Path(POLICY).with_name("policy.pub"))
    status, _, err = call(capsys, *evaluate, "--public-key", key)
    assert status == 0, err


def test_the_whole_way_from_human_to_policy_file(capsys, tmp_path, monkeypatch):
    """Every command once, as the README has them, on the smallest of runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(SCENES, "nominal", replace(SCENES["nominal"], max_steps=30))
    human = "human --out human --episodes 1 --updates-per-episode 2 --refining-updates 3"
    train = "train --human human --out run --episodes"
    small = "--set batch_size=4 --set evaluation_runs=1"
    for words in (
        human, f"{train} 2 {small}", "train --resume --episodes 3 --out run",
        "train --resume --out run",
        "export run --out policy.onnx",
        "evaluate policy.onnx --runs 1", f"evaluate {CONGESTION} --runs 1",
        "evaluate run --runs 1", "evaluate human --runs 1", "plot run",
    ):  # fmt: skip
        status, _, err = call(capsys, *words.split())
        assert status == 0, err
    assert len(read_metrics(Path("run"))) == 3
    for words, said in (
        (f"{train} 2", "--resume"),
        (f"{train} 2 {small} --resume", "was trained with episodes = 3, not 2"),
        (f"{train} 3 --seed 8 --resume", "was trained with seed = 0, not 8"),
        (human, "holds a human model"),
    ):
        assert said in refusal(capsys, *words.split())


ONES = {"picture.trunk.conv1.weight": torch.ones(3), "head.output.bias": torch.ones(1)}


@pytest.mark.parametrize("name", ["checkpoint.pt", "best_actor.pt", "human_model.pt"])
@pytest.mark.parametrize("state", [[1, 2], {"actor": ONES}, {"something": 1, "scenario": 3}])
def test_a_foreign_torch_file_is_said_in_one_line(name, state, capsys, tmp_path):
    save_torch(tmp_path / name, state)
    assert f"{name} is not a" in refusal(capsys, "evaluate", str(tmp_path), "--runs", "1")


@pytest.fixture
def config(tmp_path, capsys):
    """The settings of a run whose checkpoint cannot be read, and what resuming it says."""
    (tmp_path / "checkpoint.pt").write_bytes(b"none that could be read")
    values = asdict(RunConfig(seed=3, episodes=4, evaluate_every_steps=7, human="person"))
    values["learner"]["batch_size"] = 8

    def refused(values, *given):
        text = values if isinstance(values, str) else json.dumps(values)
        (tmp_path / "config.json").write_text(text)
        return refusal(capsys, "train", "--out", str(tmp_path), "--resume", *given)

    return values, refused


@pytest.mark.parametrize(
    ("extent", "episodes"),
    [
        ({}, 400),
        ({"steps": 5, "episodes": None}, UNLIMITED_EPISODES),
        ({"steps": 5, "episodes": 7}, 7),
    ],
)
def test_no_number_of_episodes_ends_a_training_of_so_many_steps(extent, episodes):
    assert make_config("ours", extent).episodes == episodes


GIVEN = "--seed 3 --episodes 4 --human web --set batch_size=8 --set evaluate_every_steps=7"


def test_a_changed_setting_is_named(config):
    values, refused = config
    assert "batch_size = 8, not 9" in refused(values, "--human", "web", "--set", "batch_size=9")
    del values["learner"]["gamma"]
    assert "gamma = None, not 0.95" in refused(values, *GIVEN.split())


def test_no_file_of_a_run_decides_what_is_imported(config, tmp_path, monkeypatch):
    values, refused = config
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "planted.py").write_text("raise SystemExit('imported')")
    for name in ("scenario", "algorithm", "human"):
        changed = f"--{name} planted:Any"
        assert changed in refused({**values, "human": "expert", name: "planted:Any"})


@pytest.mark.parametrize("spoilt", ["[]", "{", {"learner": 3}, {"episodes": "many"}])
def test_a_config_that_is_none_is_one_line(spoilt, config):
    values, refused = config
    refused({**values, **spoilt} if isinstance(spoilt, dict) else spoilt, *GIVEN.split())
