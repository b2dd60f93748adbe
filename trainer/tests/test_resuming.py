"""``trainer train --resume`` under other settings: what was, and what is, as they are typed."""

import json

import pytest

from trainer.tests.test_commands import call
from trainer.training.config import RunConfig


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
    status, _, err = call(capsys, "train", "--out", str(run_dir), "--resume")
    assert (status, len(err.splitlines())) == (2, 1)
    assert (
        "was trained with --seed 3 (now 0), --human keyboard|gamepad|wheel|web (now expert), "
        "--set evaluate_every_steps=7 (now 500), --set batch_size=8 (now 128): repeat"
    ) in err


def test_the_same_settings_are_let_in_as_far_as_the_checkpoint(run_dir, capsys):
    path = run_dir / "config.json"
    values = json.loads(path.read_text())
    values["human"] = "expert"
    path.write_text(json.dumps(values))
    given = tuple("expert" if word == "keyboard" else word for word in GIVEN)
    _, _, err = call(capsys, "train", "--out", str(run_dir), *given)
    assert "is not a checkpoint of this project" in err


def test_a_setting_that_the_run_did_not_have_is_named(run_dir, capsys):
    path = run_dir / "config.json"
    values = json.loads(path.read_text())
    del values["learner"]["gamma"], values["averaged_actor"]
    path.write_text(json.dumps(values))
    _, _, err = call(capsys, "train", "--out", str(run_dir), *GIVEN)
    assert "no averaged_actor (now True), no gamma (now 0.95): repeat" in err


@pytest.mark.parametrize("spoilt", [{"learner": 3}, {"episodes": None}, {"episodes": "many"}])
def test_a_config_that_is_none_is_one_line(spoilt, run_dir, capsys):
    path = run_dir / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **spoilt}))
    status, _, err = call(capsys, "train", "--out", str(run_dir), *GIVEN)
    assert (status, len(err.splitlines())) == (2, 1)
