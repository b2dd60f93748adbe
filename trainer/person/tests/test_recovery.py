"""What was recorded after the checkpoint, back in the replay buffer."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from trainer.learner.replay import ReplayBuffer
from trainer.person.recording import DISCARDED, Recorder
from trainer.person.recovery import steps_since, store_again
from trainer.person.tests.steps import recorded_step


def shape(reward, intervention):
    """A penalty of 100 for taking over."""
    return reward - 100.0 * (intervention is not None and intervention.first)


def penalises(intervention):
    return intervention is not None and intervention.first


def episode(sitting: int, first: int, length: int, human: range):
    """A recorded episode whose steps in ``human`` are the person's."""
    return [
        recorded_step(
            sitting,
            first + step,
            step=step,
            human=step in human,
            first=step == human.start and step in human,
            action=0.1 * step,
            terminated=step == length - 1,
        )
        for step in range(length)
    ]


def test_steps_come_back_with_mask_action_reward_and_pictures():
    steps = [*episode(1, 0, 4, range(1, 3)), *episode(1, 4, 3, range(0))]
    buffer = ReplayBuffer(100)
    assert store_again(buffer, steps, shape, penalises) == (7, 2)
    state = buffer.state_dict()
    assert state["human"].tolist() == [False, True, True, False, False, False, False]
    assert state["rewards"].tolist() == [0.0, -99.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert state["terminals"].tolist() == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    assert state["penalised"].tolist() == [False, True, False, False, False, False, False]
    np.testing.assert_allclose(
        state["overruled"][:, 0], [np.float32(step.policy_action) for step in steps]
    )
    batch = buffer.sample(200, np.random.default_rng(0))
    for row, index in enumerate(batch.indices):
        np.testing.assert_array_equal(batch.frames[row], steps[index].observation)
        np.testing.assert_array_equal(batch.next_frames[row], steps[index].next_observation)


def test_an_episode_that_was_thrown_away_does_not_come_back():
    steps = [*episode(1, 0, 4, range(1, 3)), *episode(1, 4, 3, range(0))]
    steps[3] = replace(steps[3], outcome=DISCARDED)
    buffer = ReplayBuffer(100)
    assert store_again(buffer, steps, shape, penalises) == (3, 0)
    assert buffer.state_dict()["rewards"].tolist() == [4.0, 5.0, 6.0]


def test_behind_a_network_the_action_answers_an_older_picture():
    steps = episode(1, 0, 5, range(0))
    buffer = ReplayBuffer(100)
    assert store_again(buffer, steps, shape, penalises, ticks_late=2) == (3, 0)
    state = buffer.state_dict()
    assert state["rewards"].tolist() == [2.0, 3.0, 4.0]
    np.testing.assert_allclose(state["actions"][:, 0], [0.2, 0.3, 0.4])
    batch = buffer.sample(50, np.random.default_rng(0))
    for row, index in enumerate(batch.indices):
        np.testing.assert_array_equal(batch.frames[row], steps[index].observation)
        np.testing.assert_array_equal(batch.next_frames[row], steps[index].next_observation)


def test_an_episode_killed_before_the_network_answered_stores_nothing():
    buffer = ReplayBuffer(100)
    assert store_again(buffer, episode(1, 0, 2, range(0)), shape, penalises, ticks_late=2) == (0, 0)
    assert buffer.added == 0


@pytest.mark.parametrize(("position", "left"), [((1, 0), 5), ((1, 2), 3), ((2, 0), 2), ((3, 0), 0)])
def test_only_what_came_after_the_checkpoint(tmp_path, position, left):
    for sitting, count in ((1, 3), (2, 2)):
        recorder = Recorder(tmp_path)
        for step in episode(sitting, 0, count, range(0)):
            recorder.write(step)
        recorder.close()
    assert len(list(steps_since(tmp_path, position))) == left
