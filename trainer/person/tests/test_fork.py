"""A person drives on in a recorded drive: `trainer drive --from`, and what learns from it."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bridge import fork
from bridge.__main__ import main as bridge
from bridge.fork import RecordedEpisode, read_episode
from bridge.tests.harness import record_in_process
from edge_runtime.tests.harness import exit_status
from edge_runtime.tests.policies import write_policy
from trainer.__main__ import main as trainer
from trainer.drivers import BEST_FILE
from trainer.person.recording import find_recordings, read_episodes, read_steps
from trainer.person.tests.people import LET_GO, QUIT, Puppet, hold
from trainer.tests.test_commands import call
from trainer.util import load_torch, save_torch

UNJUDGED = ["--out", "run", "--threads", "1", "--set", "evaluate_every_steps=0"]
FORK = ["drive", "--human", "web", "--from", "drive.mcap", "--at", "0.95s"]


@pytest.fixture
def recorded(tmp_path, monkeypatch, one_thread) -> RecordedEpisode:
    """A left turn with a constant pedal, as ``bridge record`` keeps it, where the test is."""
    monkeypatch.chdir(tmp_path)
    write_policy("policy.onnx", "constant", 0.2)
    drive = Path("drive.mcap")
    record_in_process(drive, "left_turn", Path("policy.onnx"), 3, "50ms", "variant")
    return read_episode(drive, None, None)


def test_a_persons_fork_begins_where_the_drive_was_and_is_a_demonstration(
    sit_down, recorded, capsys
):
    """Twice: the first is ended by the person, the second is quit."""
    person = Puppet([LET_GO, *[hold(-1.0)] * 60], then=QUIT)
    status, out, errors = sit_down(person, *FORK, "--out", "rec", "--episodes", "1")
    assert status == 0, errors
    (path,) = find_recordings([Path("rec")])
    (steps,) = read_episodes(read_steps(path))
    (state,) = {state.observation["frames"] for state in recorded.states[10]}
    assert steps[0].observation.tobytes() == state, "what the policy saw 1 s after the start"
    assert {(step.seed, step.scenario) for step in steps} == {(3, "left_turn")}
    assert [step.action for step in steps[1:4]] == [-1.0] * 3
    assert all(step.control == "human" for step in steps)
    assert steps[-1].speed_mps < steps[1].speed_mps
    status, out, _ = call(capsys, "human", "--from", "rec", "--episodes", "1", "--out", "me")
    assert (status, f"from {len(steps)} demonstrated steps" in out) == (0, True)
    assert call(capsys, "train", "--human", "me", "--steps", "60", *UNJUDGED)[0] == 0


def test_a_policy_may_drive_until_the_person_takes_over(sit_down, recorded):
    person = Puppet([LET_GO] * 4 + [hold(1.0)] * 4, then=QUIT)
    words = ("--policy", "policy.onnx", "--out", "rec")
    assert sit_down(person, *FORK, *words)[0] == 0
    steps = list(read_steps(find_recordings([Path("rec")])[0]))
    assert np.allclose([step.action for step in steps[:3]], 0.2)
    assert [step.human for step in steps[:6]] == [False] * 4 + [True] * 2


def test_a_planted_snapshot_of_a_run_is_found_by_bisection(recorded, capsys, monkeypatch):
    """Three validations leave three snapshots, each a run that any command takes."""
    run = ["train", "--scenario", "left_turn", "--episodes", "3", "--out", "run", "--threads", "1"]
    judged = ["snapshots=true", "evaluate_every_steps=1", "evaluation_runs=1", "warmup_steps=9999"]
    assert call(capsys, *run, *[word for each in judged for word in ("--set", each)])[0] == 0
    snapshots = sorted(Path("run/snapshots").iterdir())
    assert [path.name for path in snapshots] == [f"after_00000{n}" for n in (1, 2, 3)]
    for snapshot in snapshots:
        state = load_torch(snapshot / BEST_FILE)
        for name, pedal in (("weight", 0.0), ("bias", 1.0 if snapshot == snapshots[-1] else -1.0)):
            state["actor"][f"head.output.{name}"].fill_(pedal)
        save_torch(snapshot / BEST_FILE, state)

    def in_this_process(words, **_):  # Another would load all of torch for each.
        assert words[:3] == [sys.executable, "-m", "trainer"]
        return SimpleNamespace(returncode=exit_status(trainer, words[3:]), stderr="")

    monkeypatch.setattr(fork.subprocess, "run", in_this_process)
    words = ["bisect", "drive.mcap", "--at", "1s", "--runs", "run", "--out", "found.json"]
    assert exit_status(bridge, words) == 0
    found = json.loads(Path("found.json").read_text())
    assert found["changes_at"] == snapshots[-1].name
    assert set(found["tried"].values()) == {"timeout", "goal"}
