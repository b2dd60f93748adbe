"""``trainer view``: recorded sittings in rerun, with a road that is driven again."""

import math
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from rerun.chunk import RrdReader

from edge_runtime.cli import run_cli
from trainer.__main__ import main
from trainer.drivers import make_environment
from trainer.person.recording import Recorder, read_steps
from trainer.person.tests.steps import recorded_step
from trainer.tests.drawn import values_in
from trainer.viewer.entries import Episode, Steps
from trainer.viewer.sittings import Shown


@dataclass
class Driven:
    """What was recorded."""

    path: object
    applied: list
    human: list


def drive(directory, seeds=(4, 9), steps=15, sitting_policy=True, scenario="left_turn"):
    """A sitting: the policy wants half throttle, the person brakes from step 5 to 9."""
    env, recorder = make_environment(scenario), Recorder(directory)
    applied, human = [], []
    for episode, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        for number in range(steps):
            taken = 5 <= number < 10
            action = -1.0 if taken else 0.5
            frames = observation
            observation, reward, *_ = env.step(np.array([action], np.float32))
            step = recorded_step(recorder.sitting, recorder.index)
            recorder.write(
                msgspec.structs.replace(
                    step, scenario=scenario, seed=seed, episode=episode, step=number,
                    frames=frames.tobytes(), next_frame=observation[1].tobytes(),
                    policy_action=0.5 if sitting_policy else None, action=action, human=taken,
                    first=number == 5, reward=float(reward), speed_mps=float(env.ego.speed),
                    outcome="restarted" if number == steps - 1 else "",
                )
            )  # fmt: skip
            applied.append(action)
            human.append(taken)
    recorder.close()
    return Driven(recorder.path, applied, human)


def test_a_sitting_is_shown_whole(tmp_path, capsys):
    driven = drive(tmp_path / "drives")
    out = tmp_path / "sitting.rrd"
    assert main(["view", str(tmp_path / "drives"), "--save", str(out)]) == 0
    assert capsys.readouterr().out == "2 episodes, 30 steps, 10 of them the person's\n"
    found = values_in(out)
    assert [value for _, value in found["/action/applied"]] == driven.applied
    assert {value for _, value in found["/action/policy"]} == {0.5}
    assert found["/driver"] == [
        (0, "policy"), (5, "person"), (10, "policy"), (20, "person"), (25, "policy"),
    ]  # fmt: skip
    assert [step for step, _ in found["/return/episode"]] == [14, 29]
    assert {"/road/ego/body", "/road/roads", "/frames/now"} <= set(found)
    assert "/loss/critic" not in {path for path, rows in found.items() if rows}


def test_each_scenario_is_shown_on_its_own_ground(tmp_path):
    for scenario in ("left_turn", "left_turn", "congestion"):
        drive(tmp_path / "drives", seeds=(4,), steps=6, scenario=scenario)
    out = tmp_path / "both.rrd"
    assert main(["view", str(tmp_path / "drives"), "--save", str(out)]) == 0
    chunks = [c for c in RrdReader(str(out)).stream().to_chunks() if c.entity_path == "/road/roads"]
    drawn = [step for chunk in chunks for step in chunk.to_record_batch().to_pydict()["step"]]
    assert sorted(drawn) == [0, 12]


def test_a_road_that_would_be_driven_differently_is_not_made_up(tmp_path):
    driven = drive(tmp_path)
    other = Recorder(tmp_path)
    for number, step in enumerate(read_steps(driven.path)):
        changed = {"frames": bytes(7200)} if number == 7 else {}
        other.write(msgspec.structs.replace(step, **changed))
    other.close()
    shown = Shown()
    entries = list(shown.entries([other.path]))
    pictures = [entry.picture for entry in entries if isinstance(entry, Steps)]
    scenes = [bool(picture and picture.scene) for picture in pictures]
    assert scenes == [False] * 15 + [True] * 15
    assert shown.without_road == 1


def test_a_person_who_drives_alone_has_no_policy_beside(tmp_path):
    driven = drive(tmp_path, seeds=(4,), sitting_policy=False)
    entries = list(Shown().entries([driven.path]))
    steps = [entry.entries[0] for entry in entries if isinstance(entry, Steps)]
    assert all(math.isnan(step.policy_action) for step in steps)
    (episode,) = (entry for entry in entries if isinstance(entry, Episode))
    assert (episode.metrics.human_steps, episode.metrics.interventions) == (5, 1)
    assert episode.metrics.outcome == "restarted"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["none", "--save", "a.rrd"], "no recording in none"),
        (["drives"], "no display for a window here"),
        (["drives", "--save", "/dev/null/a.rrd"], "Not a directory"),
    ],
)
def test_bad_input_is_one_line(words, part, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    drive(tmp_path / "drives", seeds=(4,), steps=2)
    assert run_cli(main, ["view", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
