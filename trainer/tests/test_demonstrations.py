"""Drives that fill the replay before the first step: sittings, recordings and data sets."""

import math
import shutil
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from bridge.__main__ import main as bridge
from bridge.fork import read_episodes
from bridge.tests.recordings import Hand
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import refusal
from hil_tests.tests.shared.messages import make_feedback
from trainer.environments import make_environment, task_of
from trainer.learner.config import LearnerConfig
from trainer.person import PERSON
from trainer.person.recording import Recorder, packed
from trainer.person.tests.people import record, recorded_step
from trainer.training.config import RunConfig
from trainer.training.demonstrations import read_demonstrations
from trainer.training.metrics import read_metrics
from trainer.training.run import NOBODY, UNPAID, TrainingRun

DRIVE = Path(__file__).parents[2] / "hil_tests/recordings/left_turn.mcap"


@pytest.fixture(scope="module")
def drive():
    return read_episodes(DRIVE)[0]


def seen(drive: Any, step: int) -> Any:
    (data,) = drive.states[step].observation.values()
    return np.frombuffer(data, np.uint8).reshape(2, 45, 80)


def test_a_recording_is_driven_again(drive):
    (episode, *_) = read_demonstrations(DRIVE, make_environment("left_turn"))
    assert len(episode) == drive.steps
    for step, transition in enumerate(islice(episode, 20)):
        assert (transition.observation == seen(drive, step)).all()
        assert transition.action == pytest.approx(drive.applied[step][0], abs=1e-6)
        assert transition.human
    assert episode[-1].terminal or episode[-1].truncated


def test_a_recording_of_another_task_is_refused():
    with pytest.raises(UserError):
        next(read_demonstrations(DRIVE, make_environment("congestion")))


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "set"
    assert bridge(["export", str(DRIVE), "--format", "lerobot", "--out", str(out)]) == 0
    return out


def test_a_data_set_gives_back_what_was_exported(drive, data_set):
    (episode, *_) = read_demonstrations(data_set, make_environment("left_turn"))
    for step, transition in enumerate(islice(episode, 1, 20), 1):
        wanted = seen(drive, step)
        assert transition.action == pytest.approx(drive.commands[step].action, abs=1e-6)
        # The video is not exact.
        assert np.abs(transition.observation.astype(int) - wanted).mean() < 3.0
        assert (transition.next_observation[0] == transition.observation[1]).all()


def rewrite_info(old: str, new: str, folder: Path) -> None:
    path = folder / "meta/info.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def scale_actions(folder: Path) -> None:
    table = pq.read_table(path := next(folder.glob("data/*/*.parquet")))
    column = table.column_names.index("action")
    pq.write_table(table.set_column(column, "action", pa.array(np.full(len(table), 30.0))), path)


def truncate(pattern: str, folder: Path) -> None:
    path = next(folder.glob(pattern))
    path.write_bytes(path.read_bytes()[:100])


@pytest.mark.parametrize(
    "spoil",
    [
        partial(rewrite_info, '"pedal"', '"steering"'),
        partial(rewrite_info, '"fps": 10', '"fps": 30'),
        partial(rewrite_info, '"features"', '"traits"'),
        partial(truncate, "data/*/*.parquet"), partial(truncate, "videos/**/*.mp4"),
        lambda folder: shutil.rmtree(folder / "data"),
        lambda folder: shutil.rmtree(folder / "videos"), scale_actions,
    ],
)  # fmt: skip
def test_a_damaged_data_set_or_one_of_another_task_is_refused(spoil, data_set, tmp_path):
    spoil(shutil.copytree(data_set, tmp_path / "spoilt"))
    with pytest.raises(UserError, match="spoilt"):
        list(read_demonstrations(tmp_path / "spoilt", make_environment("left_turn")))


@pytest.mark.parametrize(
    "changes",
    [
        {"seen": packed(np.zeros((2, 9, 9), np.uint8))}, {"action": 3.0}, {"action": math.nan},
        {"action": [0.1, 0.2]}, {"seen": packed(np.full((2, 45, 80), math.nan))},
        {"scenario": "congestion"},
    ],
)  # fmt: skip
def test_a_sitting_that_does_not_fit_is_refused_by_who_learns_from_it(changes, tmp_path, capsys):
    record(tmp_path, [recorded_step(1, 0, human=True, control="human", **changes)])
    for words in (("train", "--demonstrations"), ("human", "--from")):
        assert "sitting-0001" in refusal(capsys, *words, tmp_path, "--out", tmp_path / "out")


def test_what_a_power_cut_left_empty_is_passed_over(tmp_path):
    record(tmp_path, [recorded_step(2, n, step=n, terminated=n == 3) for n in range(4)])
    (tmp_path / "sitting-0002.mcap").touch()
    Recorder(tmp_path)  # Killed before its first step
    (episode,) = read_demonstrations(tmp_path, make_environment("left_turn"))
    assert len(episode) == 4


def test_sittings_fill_the_replay_before_the_first_step(tmp_path):
    steps = [recorded_step(1, n, step=n, human=n > 1, terminated=n == 3) for n in range(4)]
    record(tmp_path / "sittings", steps)
    config = RunConfig(demonstrations=str(tmp_path / "sittings"))
    run = TrainingRun(config, tmp_path / "run")
    assert run.learning.replay.added == 4
    assert run.learning.replay.human_count == 2
    run.learning.close()


def test_a_scripted_human_shows_drives_that_count_as_its_seconds(tmp_path):
    learner = LearnerConfig(warmup_steps=10**6)
    config = RunConfig(
        demonstrations="human:2", guided_share=0.0, episodes=2, evaluate_every_steps=0,
        learner=learner,
    )  # fmt: skip
    run = TrainingRun(config, tmp_path / "run")
    shown = run.learning.replay.added
    assert shown == run.learning.replay.human_count > 60
    run.train()
    first, second = read_metrics(tmp_path / "run")
    assert (int(first["human_steps"]), int(second["human_steps"])) == (shown, 0)


def hand_driven(path, speeds_mps, **changes):
    """Record senses and a vehicle that a person drives; the pedal grows with the step."""
    hand, task = Hand(path), task_of(make_environment("left_turn")).text
    for step, speed_mps in enumerate(speeds_mps):
        hand.hear(step * 0.1 - 0.02, "feedback", make_feedback(
            step, speed_mps=speed_mps, action=[step / 100], **{"mode": "safe_stop", **changes}
        ))  # fmt: skip
        state = {"task": task, "observation": {"frames": bytes([step]) * (2 * 45 * 80)}}
        hand.state(step * 0.1, step, **state)
    hand.close()
    return path


def test_a_drive_by_hand_is_taken_as_recorded_from_the_first_movement_to_the_last(tmp_path):
    path = hand_driven(tmp_path / "drive.mcap", [0.0] * 5 + [0.3] * 4 + [0.0, 0.3] + [0.0] * 5)
    (episode,) = read_demonstrations(path, make_environment("left_turn"))
    # What the vehicle reports before a state is what it did after the state before.
    assert [step.observation.max() for step in episode] == [4, 5, 6, 7, 8, 9]
    assert [step.next_observation.max() for step in episode] == [5, 6, 7, 8, 9, 10]
    pedals = [step.action[0] for step in episode]
    assert pedals == pytest.approx([0.05, 0.06, 0.07, 0.08, 0.09, 0.10])
    assert all(step.human and step.reward == 0.0 for step in episode)
    assert [step.truncated for step in episode] == [False] * 5 + [True]


@pytest.mark.parametrize("algorithm", ["phil_td3", "cloning_only"])
def test_drives_without_rewards_are_said_where_they_mislead(algorithm, tmp_path, capsys):
    path = hand_driven(tmp_path / "drive.mcap", [0.3] * 4)
    config = RunConfig(algorithm=algorithm, demonstrations=str(path))
    TrainingRun(config, tmp_path / "run").learning.close()
    assert (UNPAID in capsys.readouterr().err) == (algorithm == "phil_td3")


def test_beside_a_person_the_expert_shows(tmp_path, capsys):
    config = RunConfig(human=PERSON, demonstrations="human:1")
    run = TrainingRun(config, tmp_path / "run", guide=NOBODY)
    assert run.learning.replay.human_count > 30
    assert not capsys.readouterr().err
    run.learning.close()


def test_what_the_runtime_drove_is_not_the_persons(tmp_path):
    path = hand_driven(tmp_path / "drive.mcap", [0.3] * 4, mode="drive")
    (episode,) = read_demonstrations(path, make_environment("left_turn"))
    assert not any(step.human for step in episode)


def test_a_drive_of_another_task_or_without_movement_is_refused(tmp_path):
    moved = hand_driven(tmp_path / "moved.mcap", [0.3] * 4)
    still = hand_driven(tmp_path / "still.mcap", [0.0] * 4)
    for path, scenario in ((moved, "congestion"), (still, "left_turn")):
        with pytest.raises(UserError):
            next(read_demonstrations(path, make_environment(scenario)))


@pytest.mark.parametrize(("place", "said"), [(".", "no recording"), ("human:0", "human:0")])
def test_an_empty_place_is_refused(place, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in refusal(capsys, "train", "--out", "run", "--demonstrations", place)
