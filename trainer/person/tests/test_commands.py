import json
import signal
from concurrent.futures import ProcessPoolExecutor, wait
from itertools import repeat
from pathlib import Path
from typing import Any

import pytest

from bridge.outcomes import STOPPED
from hil_tests.tests.shared.commands import call, refusal
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE
from trainer.person import Reading
from trainer.person import run as person_run
from trainer.person.recording import find_recordings, read_steps
from trainer.person.tests.people import (
    LET_GO,
    QUIT,
    Discarding,
    Puppet,
    hold,
    record,
    recorded_step,
)
from trainer.training.metrics import read_metrics
from trainer.training.run import Validation
from trainer.util import load_torch

DRIVE = ("drive", "--out", "{tmp}/rec")
TRAIN = ("train", "--out", "{tmp}/run")
HUMAN = ("human", "--out", "{tmp}/me", "--from")
MINE = "{tmp}/mine"
SHIPPED = str(Path(__file__).parents[3] / "results/policies/left_turn.onnx")
WIRE = str(Path(__file__).parents[3] / "hil_tests/recordings/left_turn.mcap")
WRONG = [
    (DRIVE, ("--human", "web", "--host", "a..b"), "the cockpit cannot listen on a..b"),
    (DRIVE, ("--scenario", "congestion", "--policy", SHIPPED), "asks for congestion: "),
    (DRIVE, ("--at", "3"), "--from F.mcap"),
    (DRIVE, ("--from", WIRE, "--episode", "1", "--at", "99"), "fork before"),
    (DRIVE, ("--from", WIRE, "--episode", "1", "--scenario", "congestion"), "was driven in"),
    (DRIVE, ("--from", "{tmp}/file"), "is no MCAP recording"),
    (TRAIN, ("--human", "web", "--algorithm", "per_td3"), "takes no guidance of a person"),
    (TRAIN, ("--human", "web", "--set", "guided_share=0.5"), "guided_share is of a scripted human"),
    (HUMAN, ("{tmp}/file",), "is no MCAP recording"),
    (HUMAN, (WIRE,), f"`python -m bridge view {WIRE}` shows one"),
    (HUMAN, ("{tmp}/policy",), "nobody took over"),
    (HUMAN, (MINE, "--scenario", "congestion"), "was driven in left_turn, not in congestion"),
    (HUMAN, (MINE, "{tmp}/crafted"), "actions that are none of left_turn"),
]


@pytest.mark.parametrize(("command", "more", "complaint"), WRONG)
def test_a_mistake_is_one_line_and_status_2(
    capsys, tmp_path, monkeypatch, command, more, complaint
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "file").write_text("not a recording")
    record(tmp_path / "policy", [recorded_step(1, 0)])
    record(tmp_path / "mine", [recorded_step(1, 0, control="human", human=True, first=True)])
    crafted = recorded_step(1, 0, control="human", human=True, human_action=(0.1, 0.2))
    record(tmp_path / "crafted", [crafted])
    before = sorted(tmp_path.iterdir())
    errors = refusal(capsys, *(word.format(tmp=tmp_path) for word in (*command, *more)))
    assert complaint in errors
    assert sorted(tmp_path.iterdir()) == before


TRAIN_HERE = ("train", "--human", "web", "--out", "run")


def test_whoever_quits_before_the_first_episode_has_lost_nothing(sit_down):
    nobody = Puppet(then=QUIT, presence=repeat(False))
    status, out, errors = sit_down(nobody, *TRAIN_HERE)
    assert (status, errors.strip()) == (0, "nothing was driven, and nothing recorded")
    assert "no episodes" in out
    assert sit_down(nobody, *TRAIN_HERE, "--resume")[0] == 0


def test_a_validation_that_is_left_out_costs_nothing_else(sit_down, monkeypatch):
    monkeypatch.setattr(Validation, "after", lambda *_: signal.raise_signal(signal.SIGINT))
    status, out, errors = sit_down(Puppet([LET_GO] * 3, then=QUIT), *TRAIN_HERE)
    assert status == 0
    assert "validation left out" in errors
    assert "1 episode, 4 steps" in out
    assert [row["outcome"] for row in read_metrics(Path("run"))] == [STOPPED]
    assert Path("run/learning_curve.png").is_file()


class UntilChecked(Puppet):
    """Takes over now and then, and quits when it is told how the policy does alone."""

    def poll(self, now_s: float) -> Reading:
        seen = self.views[-1]
        if "alone" in seen.progress:
            return QUIT
        return hold(1.0) if seen.step % 20 == 10 else LET_GO


class Prompt(ProcessPoolExecutor):
    """Has answered before the next step: all that is trained meanwhile takes a processor."""

    def submit(self, *work: Any, **more: Any) -> Any:
        future = super().submit(*work, **more)
        wait([future])
        return future


def test_the_policy_is_validated_behind_the_persons_back_and_kept(sit_down, monkeypatch):
    monkeypatch.setattr(person_run, "ProcessPoolExecutor", Prompt)
    settings = "warmup_steps=8", "evaluate_every_steps=20", "evaluation_runs=2", "batch_size=4"
    quick = ["--threads", "1", *(word for name in settings for word in ("--set", name))]
    person = UntilChecked()
    status, _, errors = sit_down(person, *TRAIN_HERE, *quick)
    assert status == 0, errors
    rows = read_metrics(Path("run"))
    (checked,) = (row for row in rows[:-1] if row["validation_success"] != "nan")
    assert person.views[-1].progress.endswith(f"in {float(checked['validation_success']):.0%}")
    assert load_torch(Path("run") / BEST_FILE)["episode"] <= len(rows)


def test_a_human_model_learns_from_all_that_the_hands_did(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hands = {"control": "human", "human": True}
    letting_go = recorded_step(1, 8, control="returning", human=True, human_action=0.0)
    thrown_away = [
        recorded_step(1, 10, episode=1, step=0, first=True, **hands),
        recorded_step(1, 11, episode=1, step=1, outcome="discarded", **hands),
    ]
    held = [recorded_step(1, n, first=n == 0, **hands) for n in range(8)]
    ended = recorded_step(1, 9, terminated=True)
    record(Path("a"), [*held, letting_go, ended, *thrown_away])
    record(Path("b"), held[:1])
    words = "human --from a b --episodes 1 --updates-per-episode 2 --refining-updates 3 --out me"
    status, out, errors = call(capsys, *words.split())
    assert (status, errors.count("error")) == (0, 0)
    assert "human model from 9 demonstrated steps" in out
    about = json.loads(Path("me/human.json").read_text())
    assert (about["demonstrations"], about["interventions"]) == (9, 2)


def test_a_person_is_not_imitated_in_what_they_threw_away(sit_down):
    """Three episodes, the second thrown away after its end: neither stored nor brought back."""
    quick = ["--threads", "1", "--set", "evaluate_every_steps=0", "--set", "batch_size=4"]
    person = Discarding(discarded={1}, episodes=3)
    status, out, errors = sit_down(person, *TRAIN_HERE, *quick)
    assert status == 0, errors
    assert "1 discarded" in errors
    rows = read_metrics(Path("run"))
    assert [row["outcome"] == "discarded" for row in rows] == [False, True, False]
    first, thrown, last = (int(row["steps"]) for row in rows)
    assert [int(row["total_steps"]) for row in rows] == [first, first, first + last]
    assert f"{first + last} steps" in out
    replay = load_torch(Path("run") / CHECKPOINT_FILE)["learning"]["replay"]
    assert int(replay["human"].sum()) == sum(int(rows[n]["human_steps"]) for n in (0, 2))
    (recording,) = find_recordings([Path("run")])
    assert len(list(read_steps(recording))) == first + thrown + last, "all of it is recorded"
