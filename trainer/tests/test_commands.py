"""The command line as a user meets it, mistakes included."""

import argparse
import json
import math
import shutil
import time
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from edge_runtime.tests.harness import exit_status
from edge_runtime.tests.policies import public_pem
from edge_runtime.util import UserError
from trainer.__main__ import main
from trainer.options import add_time_limit, deadline_s, until
from trainer.training.command import settings, with_setting
from trainer.training.config import RunConfig
from trainer.util import save_torch

POLICY = str(Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx")


def call(capsys, *arguments: str) -> tuple[int, str, str]:
    """Run ``python -m trainer`` in this process: exit status, stdout, stderr."""
    status = exit_status(main, list(arguments))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def refusal(capsys, *arguments: str) -> str:
    """The one line with which a command ends that is given bad input."""
    status, out, err = call(capsys, *arguments)
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1)
    assert "Traceback" not in err
    return err


WRONG = [
    ("train", "--scenario", "moon", "--out", "x"),
    ("train", "--algorithm", "magic", "--out", "x"),
    ("train", "--human", "mouse", "--out", "{tmp}/x"),
    ("train", "--episodes", "0", "--out", "x"),
    ("train", "--out", "{tmp}/x", "--set", "no_such=1"),
    ("train", "--out", "{tmp}/x", "--set", "batch_size=many"),
    ("train", "--out", "{tmp}/x", "--set", "batch_size"),
    ("train", "--out", "{tmp}/x", "--set", "batch_size=0"),
    ("train", "--out", "{tmp}/x", "--set", "gamma=nan"),
    ("train", "--out", "{tmp}/x", "--set", "evaluation_runs=0"),
    ("train", "--out", "{tmp}/x", "--seed", "99999999999999999999999"),
    ("train", "--out", "{tmp}/x", "--max-minutes", "0"),
    ("train", "--out", "{tmp}/x", "--max-minutes", "nan"),
    ("train", "--out", "{tmp}/x", "--resume"),
    ("train", "--out", "{tmp}/x", "--human", "{tmp}/nobody"),
    ("train", "--out", "{tmp}/file/x"),
    ("evaluate", "{tmp}/nothing.onnx"),
    ("evaluate", "{tmp}/nothing"),
    ("evaluate", "{tmp}/file"),
    ("evaluate", "expert", "--runs", "-1"),
    ("evaluate", "expert", "--condition", "rain"),
    ("evaluate", "expert", "--out", "/dev/null/r.json"),
    ("export", "{tmp}/nothing", "--out", "{tmp}/p.onnx"),
    ("export", "{tmp}", "--out", "{tmp}/p.onnx"),
    ("export", "{tmp}", "--out", "{tmp}/p.onnx", "--key", "{tmp}/no.key"),
    ("export", "{tmp}", "--out", "{tmp}/p.txt"),
    ("picture", "expert", "--time", "-1", "--out", "{tmp}/p.png"),
    ("picture", "expert", "--out", "{tmp}/p.jpg"),
    ("plot", "{tmp}"),
    ("picture", "expert", "--out", "/dev/null/p.png"),
    ("picture", "{tmp}/nobody", "--out", "{tmp}/p.png"),
    ("human", "--out", "{tmp}/file"),
    ("bench", "--threads", "-1"),
    ("train", "--out", "{tmp}/x", "--threads", "1025"),
    ("train", "--out", "{tmp}/x", "--set", "replay_capacity=99999999999999"),
    ("plot", "{tmp}", "--out", "{tmp}/c.pdf"),
    ("plot", "{tmp}", "--out", "{tmp}/c.txt"),
    ("train", "--out", ""),
    ("drive", "--out", ""),
    ("human", "--out", ""),
    ("evaluate", "expert", "--out", ""),
    ("export", "{tmp}", "--out", ""),
    ("plot", "{tmp}", "--out", ""),
    ("picture", "expert", "--out", ""),
    ("view", "{tmp}", "--save", ""),
    ("bench", "--out", ""),
    ("experiment", "status", "--results", ""),
    ("bench", "--out", "/dev/null/b.json"),
]


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_bad_input_gets_one_line_and_status_2(arguments, capsys, tmp_path):
    (tmp_path / "file").write_text("a file")
    before = sorted(tmp_path.rglob("*"))
    refusal(capsys, *(a.format(tmp=tmp_path) for a in arguments))
    assert sorted(tmp_path.rglob("*")) == before


def test_evaluate_reports_what_the_contract_asks_for(capsys, tmp_path):
    status, out, _ = call(capsys, "evaluate", "expert", "--runs", "3", "--seed", "5")
    assert status == 0
    report = json.loads(out)
    assert report["success_rate"] == 1.0
    assert report["policy_id"] == "expert"
    assert (report["episodes"], report["seed"], report["condition"]) == (3, 5, "nominal")
    keys = {
        "scenario", "condition", "episodes", "success_rate", "collision_rate",
        "surviving_distance_m", "episode_reward", "episode_time_s", "lateral_acceleration_mps2",
        "longitudinal_acceleration_mps2", "policy_id", "seed",
    }  # fmt: skip
    assert keys <= set(report)
    assert set(report["surviving_distance_m"]) == {"mean", "std"}


@pytest.fixture
def workshop(tmp_path, monkeypatch):
    """Where somebody has made keys of their own, as the README's `deploy keys` does."""
    monkeypatch.chdir(tmp_path)
    Path("keys").mkdir()
    Path("keys/policy.pub").write_bytes(public_pem(Ed25519PrivateKey.generate()))


def test_a_shipped_policy_is_verified_with_the_key_beside_it(workshop, capsys):
    """Not with another one's, which lies in the working directory."""
    for command in (["evaluate", POLICY, "--runs", "1"], ["picture", POLICY, "--out", "a.png"]):
        status, _, err = call(capsys, *command)
        assert status == 0, err
    drive = ["drive", "--human", "keyboard", "--policy", POLICY, "--public-key", "none.pub"]
    assert "public key none.pub does not exist" in refusal(capsys, *drive)


def test_a_named_key_decides(workshop, capsys):
    for end in ("", ".sig"):
        shutil.copy(POLICY + end, f"p.onnx{end}")
    evaluate = ["evaluate", "p.onnx", "--runs", "2"]
    err = refusal(capsys, *evaluate)
    assert "public key keys/policy.pub: " in err
    assert "--public-key" in err
    key = str(Path(POLICY).with_name("policy.pub"))
    status, _, err = call(capsys, *evaluate, "--public-key", key)
    assert status == 0, err


def test_noise_disturbs_and_is_reproducible(capsys, tmp_path):
    reports = []
    for number, condition in enumerate(("noise", "noise", "nominal")):
        out = str(tmp_path / f"{number}.json")
        arguments = ("evaluate", "expert", "--runs", "2", "--condition", condition, "--out", out)
        assert call(capsys, *arguments)[0] == 0
        reports.append(json.loads((tmp_path / f"{number}.json").read_text()))
    noisy, again, calm = ([e["actions"] for e in report["per_episode"]] for report in reports)
    assert noisy == again != calm


def test_the_whole_way_from_human_to_policy_file(capsys, tmp_path):
    """Every command once, as the README has them, on the smallest of runs."""
    human, run = str(tmp_path / "human"), str(tmp_path / "run")
    policy = str(tmp_path / "policy.onnx")
    steps = [
        ("human", "--out", human, "--episodes", "1", "--updates-per-episode", "2",
         "--refining-updates", "3"),
        ("train", "--human", human, "--out", run, "--episodes", "2", "--set", "batch_size=4",
         "--set", "evaluation_runs=1"),
        ("train", "--human", human, "--out", run, "--episodes", "3", "--set", "batch_size=4",
         "--set", "evaluation_runs=1", "--resume"),
        ("export", run, "--out", policy),
        ("evaluate", policy, "--runs", "1"),
        ("evaluate", run, "--runs", "1"),
        ("evaluate", human, "--runs", "1"),
        ("plot", run),
        ("picture", policy, "--time", "1", "--out", str(tmp_path / "scene.png")),
    ]  # fmt: skip
    for step in steps:
        status, _, err = call(capsys, *step)
        assert status == 0, err
    again = ("train", "--human", human, "--out", run, "--episodes")
    changed = "--seed 0 (now 8), --set evaluation_runs=1 (now 30), --set batch_size=4 (now 128)"
    for arguments, said in (
        ((*again, "2"), "--resume"),
        ((*steps[2][:6], "2", *steps[2][7:]), "not fewer"),
        ((*again, "4", "--seed", "8", "--resume"), changed),
        (steps[0], "holds a human model"),
    ):
        assert said in refusal(capsys, *arguments)


def test_a_replay_buffer_beyond_the_memory_is_one_line(capsys, tmp_path, monkeypatch):
    def too_much(*_):
        raise MemoryError("Unable to allocate 3.4 TiB")

    monkeypatch.setattr("trainer.learner.replay.np.empty", too_much)
    err = refusal(capsys, "train", "--out", str(tmp_path / "x"), "--episodes", "1")
    assert "no memory for a replay buffer of 100000 transitions: --set replay_capacity=N" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["checkpoint.pt", "best_actor.pt", "human_model.pt"])
def test_a_foreign_torch_file_is_said_in_one_line(name, capsys, tmp_path):
    save_torch(tmp_path / name, {"something": 1})
    refusal(capsys, "evaluate", str(tmp_path), "--runs", "1")


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("printed_reward", "expected NAME=VALUE"),
        ("printed_reward=maybe", "expected true or false, got 'maybe'"),
        ("batch_size=1.5", "expected a whole number, got '1.5'"),
        ("gamma=", "expected a number, got ''"),
    ],
)
def test_a_wrong_setting_is_told_what_would_be_right(assignment, expected):
    with pytest.raises(UserError, match=f"^--set {assignment}: {expected}$"):
        with_setting(RunConfig(), assignment)


@pytest.fixture
def run_dir(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"none that could be read")
    values = RunConfig(seed=3, episodes=4, evaluate_every_steps=7, human="person").as_dict()
    values["learner"]["batch_size"] = 8
    (tmp_path / "config.json").write_text(json.dumps(values))
    return tmp_path


GIVEN = (
    "--resume", "--seed", "3", "--episodes", "4", "--human", "keyboard", "--set", "batch_size=8",
    "--set", "evaluate_every_steps=7",
)  # fmt: skip


def test_changed_settings_are_named_as_they_are_given(run_dir, capsys):
    assert (
        "was trained with --seed 3 (now 0), --human keyboard|gamepad|wheel|web (now expert), "
        "--set evaluate_every_steps=7 (now 500), --set batch_size=8 (now 128): repeat"
    ) in refusal(capsys, "train", "--out", str(run_dir), "--resume")


def test_what_the_run_had_is_let_in_as_far_as_the_checkpoint_and_what_it_lacked_named(
    run_dir, capsys
):
    path = run_dir / "config.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "human": "expert"}))
    given = tuple("expert" if word == "keyboard" else word for word in GIVEN)
    resume = ("train", "--out", str(run_dir))
    assert "is not a checkpoint of this project" in refusal(capsys, *resume, *given)
    del values["learner"]["gamma"], values["averaged_actor"]
    path.write_text(json.dumps(values))
    err = refusal(capsys, *resume, *GIVEN)
    assert "no averaged_actor (now True), no gamma (now 0.95): repeat" in err


@pytest.mark.parametrize(
    "spoilt", ["[]", "{", "null", {"learner": 3}, {"episodes": None}, {"episodes": "many"}]
)
def test_a_config_that_is_none_is_one_line(spoilt, run_dir, capsys):
    path = run_dir / "config.json"
    if isinstance(spoilt, dict):
        spoilt = json.dumps({**json.loads(path.read_text()), **spoilt})
    path.write_text(spoilt)
    refusal(capsys, "train", "--out", str(run_dir), *GIVEN)


def limit(*arguments: str) -> float:
    parser = argparse.ArgumentParser()
    add_time_limit(parser, "stop")
    return deadline_s(parser.parse_args(arguments))


def test_minutes_count_from_now_and_none_is_no_limit():
    before_s = time.monotonic()
    end_s = limit("--max-minutes", "2")
    assert before_s + 120.0 <= end_s <= time.monotonic() + 120.0
    assert limit() == math.inf


def test_nothing_is_begun_after_the_deadline():
    begun = []

    def parts():
        for part in range(3):
            begun.append(part)
            yield part

    assert list(until(math.inf, parts())) == [0, 1, 2]
    begun.clear()
    assert list(until(time.monotonic() - 1.0, parts())) == [0]
    assert begun == [0]


def test_a_human_model_whose_time_is_up_is_refined_in_proportion_and_kept(tmp_path, capsys):
    out = tmp_path / "human"
    arguments = ["human", "--out", str(out), "--max-minutes", "1e-6", "--updates-per-episode", "1"]
    assert main([*arguments, "--refining-updates", "100"]) == 0
    report = json.loads((out / "human.json").read_text())
    assert report["episodes"] == 1
    assert report["config"]["episodes"] == 50
    said = capsys.readouterr().err
    assert "the time is over after 1 of 50 episodes" in said
    assert "refining: 2/2" in said  # 100 steps are for 50 episodes
    assert (out / "human_model.pt").is_file()


def test_the_settings_are_listed_with_defaults_and_meanings(capsys):
    status, out, _ = call(capsys, "train", "--set")
    assert status == 0
    lines = out.splitlines()
    assert all(len(line) <= 98 for line in lines)
    assert "  batch_size=128                    transitions in a minibatch (table A5: N)" in lines
    assert [name for name in settings() if f"  {name}=" not in out] == []


def test_a_misspelt_setting_or_command_is_told_what_comes_near(capsys, tmp_path):
    given = ("train", "--out", str(tmp_path / "x"), "--set", "bach_size=4")
    assert "did you mean batch_size?" in refusal(capsys, *given)
    assert "did you mean train?" in refusal(capsys, "trian")
    # A bare command prints its help.
    status, out, _ = call(capsys)
    assert (status, "experiment" in out) == (0, True)
