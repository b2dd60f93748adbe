from itertools import pairwise, repeat

import numpy as np
import pytest

from bridge.outcomes import COLLISION, DISCARDED, FAILED, GOAL, RESTARTED, STOPPED, TRUNCATED
from trainer.evaluation import constant_driver
from trainer.person import MAX_SLEW
from trainer.person.recording import read_episodes, read_steps
from trainer.person.session import drive
from trainer.person.tests.people import (
    LET_GO,
    QUIT,
    Puppet,
    hold,
    make_sitting,
    recorded_step,
    wish,
)


def drive_and_read(directory, readings=(), policy: float | None = 0.5, person=None, presence=()):
    """Drive as the readings say, then quit: outcomes, recorded steps, views, and the sitting."""
    person = person or Puppet(readings, QUIT, presence)
    sitting = make_sitting(directory, person)
    drive(sitting, None if policy is None else constant_driver(policy), abs)
    sitting.close()
    path = sitting.recorder.path
    return sitting.outcomes, list(read_steps(path)) if path.exists() else [], person.views, sitting


def test_taking_over_changes_the_very_step_and_is_recorded_with_its_mask(tmp_path):
    readings = [LET_GO, LET_GO, hold(-1.0), hold(-1.0), hold(-1.0), LET_GO, LET_GO, LET_GO, LET_GO]
    _, steps, views, _ = drive_and_read(tmp_path, readings)
    assert [s.action for s in steps[:9]] == [0.5, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0, 0.5, 0.5]
    assert [s.human for s in steps[:9]] == [False] * 2 + [True] * 5 + [False] * 2
    assert [s.first for s in steps[:9]] == [False] * 2 + [True] + [False] * 6
    assert {s.policy_action for s in steps} == {0.5}
    assert [s.human_action for s in steps[2:5]] == [-1.0] * 3
    assert MAX_SLEW == 0.5
    # The person sees what is applied.
    driven = [view for view in views if view.episode == 0 and not view.message]
    np.testing.assert_array_equal(driven[0].frames, steps[0].observation)
    for step, view in zip(steps, driven[1:], strict=False):
        assert (view.applied_action, view.control) == (step.action, step.control)


def test_a_person_who_drives_alone_is_obeyed_at_once_by_the_car_too(tmp_path):
    readings = [LET_GO, *[hold(1.0)] * 3, *[hold(-1.0)] * 8]
    _, steps, *_ = drive_and_read(tmp_path, readings, policy=None)
    assert [s.action for s in steps[:12]] == [0.0] + [1.0] * 3 + [-1.0] * 8
    assert all(s.human and s.control == "human" and s.policy_action is None for s in steps)
    assert [s.first for s in steps[:3]] == [True, False, False]
    assert steps[3].speed_mps > max(steps[1].speed_mps, steps[11].speed_mps)


def test_quitting_ends_the_episode_and_keeps_its_last_step(tmp_path):
    outcomes, steps, *_ = drive_and_read(tmp_path, [LET_GO] * 4)
    assert (dict(outcomes), len(steps)) == ({STOPPED: 1}, 5)
    for step, following in pairwise(steps):
        np.testing.assert_array_equal(step.next_observation, following.observation)
    last = steps[-1]
    assert (last.truncated, last.terminated, last.outcome) == (True, False, STOPPED)


@pytest.mark.parametrize(("wished", "outcome"), [("restart", RESTARTED), ("discard", DISCARDED)])
def test_an_episode_begun_anew_or_thrown_away_ends_and_is_marked(tmp_path, wished, outcome):
    readings = [hold(1.0), hold(1.0), wish(wished), *[LET_GO] * 14]
    outcomes, steps, _, sitting = drive_and_read(tmp_path, readings)
    assert dict(outcomes) == {outcome: 1, STOPPED: 1}
    assert [(s.step, s.outcome) for s in steps[:3]] == [(0, ""), (1, ""), (2, outcome)]
    assert steps[2].truncated
    assert [step.episode for step in steps] == [0] * 3 + [1] * (len(steps) - 3)
    assert steps[3].seed != steps[0].seed
    kept = [episode[0].episode for episode in read_episodes(steps)]
    discarded = wished == "discard"
    assert kept == ([1] if discarded else [0, 1])
    assert ("1 discarded" in sitting.summary()) == discarded


@pytest.mark.parametrize(("word", "told"), [("succeeded", GOAL), ("failed", FAILED)])
def test_the_persons_word_counts_where_the_environment_has_none(tmp_path, word, told):
    for ended, outcome in ((TRUNCATED, told), (COLLISION, COLLISION)):
        sitting = make_sitting(tmp_path / ended, Puppet([LET_GO, wish(word)]))
        sitting.begin(1, *sitting.env.reset(seed=1))
        sitting.recorder._last = recorded_step(1, 0, terminated=True, outcome=ended)
        assert sitting.end_episode(ended) == outcome
        sitting.close()
        assert [step.outcome for step in read_steps(sitting.recorder.path)] == [outcome]


def test_a_pause_holds_the_car_still_and_goes_on_where_it_was(tmp_path):
    pause = wish("pause")
    readings = [LET_GO, LET_GO, pause, *[LET_GO] * 10, pause, *[LET_GO] * 3]
    _, steps, views, _ = drive_and_read(tmp_path, readings)
    assert [s.step for s in steps] == list(range(7))
    scenes = [str(view.scene) for view in views if view.paused]
    assert len(scenes) >= 10
    assert len(set(scenes)) == 1


def test_without_the_person_no_episode_begins(tmp_path):
    outcomes, steps, views, _ = drive_and_read(tmp_path, [LET_GO] * 5, presence=repeat(False))
    assert (dict(outcomes), steps) == ({}, [])
    assert {view.message for view in views} == {"waiting for the person's device"}
    assert list(tmp_path.iterdir()) == []


def test_nobody_demonstrates_where_nobody_is(tmp_path):
    readings = [hold(1.0)] * 2 + [LET_GO] * 2 + [hold(1.0)]
    there = [True, True, True, False, False]
    steps = drive_and_read(tmp_path, readings, policy=None, presence=there)[1][:5]
    human, policy = (True, "human"), (False, "policy")
    assert [(step.human, step.control) for step in steps] == [human, human, policy, policy, human]
    assert [step.first for step in steps] == [True, False, False, False, True]
