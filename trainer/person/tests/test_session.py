"""A sitting in the left turn: taking over, pausing, beginning anew, quitting; all of it kept."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from trainer.person.drive import drive
from trainer.person.interface import LET_GO, Person
from trainer.person.recording import DISCARDED, read_episodes, read_steps
from trainer.person.session import RESTARTED, STOPPED, Pacer
from trainer.person.takeover import MAX_SLEW
from trainer.person.tests.people import QUIT, Discarding, Hands, hold, make_sitting, wish


class Steady:
    """A policy of one action."""

    def __init__(self, action: float) -> None:
        self.action = np.array([action], np.float32)

    def reset(self) -> None:
        """No memory."""

    def act(self, observation):
        return self.action


def who_is_there(monkeypatch, *presence: bool):
    """Hands whose device is there, or not, each time it is asked; then for good."""
    there = iter(presence)
    monkeypatch.setattr(Hands, "present", property(lambda _: next(there, True)), raising=False)


def drive_and_read(directory, readings, policy=0.5, **options):
    sitting, eyes = make_sitting(directory, readings, **options)
    outcomes = drive(sitting, None if policy is None else Steady(policy), 0, None)
    sitting.close()
    return outcomes, list(read_steps(sitting.recorder.path)), eyes.views


def test_taking_over_changes_the_very_step_and_is_recorded_with_its_mask(tmp_path):
    readings = [LET_GO, LET_GO, hold(-1.0), hold(-1.0), hold(-1.0), LET_GO, LET_GO, LET_GO, LET_GO]
    _, steps, _ = drive_and_read(tmp_path, readings)
    assert [s.action for s in steps[:9]] == [0.5, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0, 0.5, 0.5]
    assert [s.human for s in steps[:9]] == [False] * 2 + [True] * 5 + [False] * 2
    assert [s.first for s in steps[:9]] == [False] * 2 + [True] + [False] * 6
    assert {s.policy_action for s in steps} == {0.5}
    assert [s.human_action for s in steps[2:5]] == [-1.0] * 3
    assert MAX_SLEW == 0.5


def test_the_car_does_what_is_recorded(tmp_path):
    readings = [hold(1.0)] * 3 + [hold(-1.0)] * 8
    _, steps, _ = drive_and_read(tmp_path, readings, policy=None, alone=True)
    speeds = [s.speed_mps for s in steps]
    assert speeds[2] > speeds[0]
    assert speeds[10] < speeds[3]


def test_recorded_transitions_follow_each_other(tmp_path):
    _, steps, _ = drive_and_read(tmp_path, [LET_GO] * 12)
    for step, following in pairwise(steps):
        np.testing.assert_array_equal(step.next_observation, following.observation)


def test_who_drives_alone_is_obeyed_at_once(tmp_path):
    readings = [LET_GO, hold(1.0), hold(-1.0)]
    _, steps, _ = drive_and_read(tmp_path, readings, policy=None, alone=True)
    assert [s.action for s in steps[:3]] == [0.0, 1.0, -1.0]
    assert all(s.human and s.control == "human" for s in steps)
    assert [s.first for s in steps[:3]] == [True, False, False]
    assert steps[0].policy_action is None


def test_quitting_ends_the_episode_and_keeps_its_last_step(tmp_path):
    outcomes, steps, _ = drive_and_read(tmp_path, [LET_GO] * 4)
    assert dict(outcomes) == {STOPPED: 1}
    assert len(steps) == 5
    assert (steps[-1].truncated, steps[-1].terminated) == (True, False)
    assert steps[-1].outcome == STOPPED


def test_a_sitting_that_is_over_has_nobody_to_heed(tmp_path):
    sitting, _ = make_sitting(tmp_path, [])
    assert sitting.quit()
    assert sitting.stop
    sitting.stop = False
    sitting.close()
    assert not sitting.quit()
    assert not sitting.stop


def test_restarting_begins_another_episode(tmp_path):
    readings = [LET_GO, LET_GO, wish("restart"), *[LET_GO] * 14]
    outcomes, steps, _ = drive_and_read(tmp_path, readings)
    assert outcomes[RESTARTED] == 1
    assert [s.step for s in steps if s.episode == 0] == [0, 1, 2]
    assert steps[3].episode == 1
    assert steps[3].seed != steps[0].seed


def test_an_episode_that_is_thrown_away_ends_and_is_marked(tmp_path):
    readings = [hold(1.0), hold(1.0), wish("discard"), *[LET_GO] * 14]
    sitting, _ = make_sitting(tmp_path, readings)
    outcomes = drive(sitting, Steady(0.5), 0, None)
    sitting.close()
    steps = list(read_steps(sitting.recorder.path))
    assert dict(outcomes) == {DISCARDED: 1, STOPPED: 1}
    assert [step.outcome for step in steps if step.episode == 0] == ["", "", DISCARDED]
    assert steps[2].truncated
    assert [step.episode for step in steps[3:]] == [1] * (len(steps) - 3)
    assert [episode[0].episode for episode in read_episodes(steps)] == [1]
    assert (sitting.discarded, sitting.episodes, sitting.human_steps) == (1, 1, 0)


def test_what_has_just_ended_can_still_be_thrown_away(tmp_path):
    sitting, eyes = make_sitting(tmp_path, [])
    sitting.person = Person(Discarding(eyes, discarded={0}, episodes=2), eyes)
    outcomes = drive(sitting, Steady(1.0), 0, None)
    sitting.close()
    first, second = (
        [step for step in read_steps(sitting.recorder.path) if step.episode == number]
        for number in (0, 1)
    )
    assert outcomes[DISCARDED] == 1
    assert (first[-1].outcome, first[-1].terminated or first[-1].truncated) == (DISCARDED, True)
    assert DISCARDED not in {step.outcome for step in (*first[:-1], *second)}
    assert [step.index for step in (*first, *second)] == list(range(len(first) + len(second)))


def test_out_of_a_pause_an_episode_can_be_thrown_away(tmp_path):
    readings = [LET_GO, wish("pause"), LET_GO, wish("discard"), *[LET_GO] * 3]
    assert drive_and_read(tmp_path, readings)[0][DISCARDED] == 1


def test_a_wish_from_before_an_episode_throws_nothing_away(tmp_path, monkeypatch):
    sitting, _ = make_sitting(tmp_path, [wish("discard"), *[LET_GO] * 4])
    who_is_there(monkeypatch, False)
    assert dict(drive(sitting, Steady(0.0), 0, None)) == {STOPPED: 1}


def test_a_pause_holds_the_car_still_and_goes_on_where_it_was(tmp_path):
    pause = wish("pause")
    readings = [LET_GO, LET_GO, pause, *[LET_GO] * 10, pause, *[LET_GO] * 3]
    _, steps, views = drive_and_read(tmp_path, readings)
    assert [s.step for s in steps] == list(range(len(steps)))
    assert len(steps) == 7
    paused = [view for view in views if view.paused]
    assert len(paused) >= 10
    assert len({str(view.scene) for view in paused}) == 1


@pytest.mark.parametrize("wished", ["quit", "restart"])
def test_out_of_a_pause_one_can_quit_or_restart(tmp_path, wished):
    readings = [LET_GO, wish("pause"), LET_GO, wish(wished), *[LET_GO] * 3]
    outcomes, _, _ = drive_and_read(tmp_path, readings)
    assert outcomes[STOPPED if wished == "quit" else RESTARTED] >= 1


def test_the_person_sees_what_is_applied(tmp_path):
    _, steps, views = drive_and_read(tmp_path, [hold(-1.0)] * 6)
    driven = [view for view in views if view.episode == 0 and not view.message]
    for step, view in zip(steps, driven[1:], strict=False):
        assert (view.applied_action, view.control) == (step.action, step.control)
    np.testing.assert_array_equal(driven[0].frames, steps[0].observation)


def test_without_the_person_no_episode_begins(tmp_path, monkeypatch):
    sitting, eyes = make_sitting(tmp_path, [LET_GO] * 5, then=QUIT)
    monkeypatch.setattr(sitting.person.device, "present", False)
    assert not drive(sitting, Steady(0.0), 0, None)
    sitting.close()
    assert {view.message for view in eyes.views} == {"waiting for the person's device"}
    assert not sitting.recorder.path.exists()


def test_what_was_wished_before_an_episode_does_not_end_it(tmp_path, monkeypatch):
    sitting, _ = make_sitting(tmp_path, [wish("restart"), *[LET_GO] * 4])
    who_is_there(monkeypatch, False)
    outcomes = drive(sitting, Steady(0.0), 0, None)
    assert dict(outcomes) == {STOPPED: 1}


def test_nobody_demonstrates_where_nobody_is(tmp_path, monkeypatch):
    sitting, _ = make_sitting(tmp_path, [hold(1.0)] * 2 + [LET_GO] * 2 + [hold(1.0)], alone=True)
    who_is_there(monkeypatch, True, True, True, False, False)
    drive(sitting, None, 0, None)
    sitting.close()
    steps = list(read_steps(sitting.recorder.path))[:5]
    assert [step.human for step in steps] == [True, True, False, False, True]
    assert [step.control for step in steps] == ["human"] * 2 + ["policy"] * 2 + ["human"]
    assert [step.first for step in steps] == [True, False, False, False, True]


def test_sittings_drive_other_episodes(tmp_path):
    seeds = [
        {step.seed for step in drive_and_read(tmp_path, [wish("restart"), *[LET_GO] * 12])[1]}
        for _ in range(2)
    ]
    assert len(seeds[0] | seeds[1]) == 4


class Clock:
    """Moves when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def pass_s(self, seconds: float) -> None:
        self.now_s += seconds


def run(works_s: list[float]) -> tuple[list[float], int]:
    """When each period begins, from the first deadline on, and how many were late."""
    clock = Clock()
    pacer = Pacer(0.1, clock, clock.pass_s)
    began = []
    for work_s in works_s:
        clock.pass_s(work_s)
        pacer.wait()
        began.append(clock.now_s - 100.1)
    return began, pacer.late


def test_work_within_the_period_does_not_shift_it():
    began, late = run([0.0, 0.05, 0.09, 0.01])
    assert began == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert late == 0


def test_a_short_delay_is_counted_and_caught_up():
    began, late = run([0.0, 0.15, 0.0, 0.0])
    assert began == pytest.approx([0.0, 0.15, 0.2, 0.3])
    assert late == 1


def test_after_a_long_one_the_periods_begin_anew():
    began, late = run([0.0, 0.5, 0.0, 0.0])
    assert began == pytest.approx([0.0, 0.5, 0.6, 0.7])
    assert late == 1


def test_a_hair_is_not_late():
    began, late = run([0.0, 0.11, 0.0])
    assert began == pytest.approx([0.0, 0.11, 0.2])
    assert late == 0
