"""Learning beside the environment, and what becomes of it when something fails."""

import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.td3 import Losses
from trainer.tests.scripted import CONFIG, ScriptedEnv, scripted_run
from trainer.training import run as run_module
from trainer.training.learning import LearningThread

SMALL = LearnerConfig(batch_size=8, replay_capacity=60, warmup_steps=1)
PRIORITIES = np.full(SMALL.batch_size, 2.0)
PICTURE = np.random.default_rng(1).integers(0, 255, (2, 45, 80)).astype(np.uint8)


@pytest.fixture
def learning():
    """One that is filled, with every third step the human's; its learner is yet to be scripted."""
    made: Any = LearningThread(SMALL, PHIL, 1, 1)
    made.start_episode(PICTURE)
    for step in range(20):
        made.add(np.full(1, step / 20, np.float32), float(step % 5), PICTURE, False, step % 3 == 0)
    yield made
    made.close()


def losses(critic: float) -> Losses:
    return Losses(critic, 2.0 * critic, 3.0 * critic, 4.0 * critic, PRIORITIES)


def test_an_episode_reports_the_means_of_its_updates_and_then_forgets_them(learning):
    scripted = [losses(1.0), losses(3.0)]
    learning.learner.update = lambda batch, beta: scripted.pop(0)
    for _ in range(2):
        learning.begin(0.0)
        learning.finish()
    episode = learning.end_episode(0.0)
    found = (episode.critic_loss, episode.policy_loss, episode.cloning_loss, episode.value)
    assert found == (2.0, 4.0, 6.0, 8.0)
    assert 1.0 < episode.policy_priority <= 2.0
    after = learning.end_episode(0.0)
    assert np.isnan([after.critic_loss, after.policy_loss, after.cloning_loss, after.value]).all()
    assert after.learning_s == after.waiting_s == 0.0


def test_an_update_that_takes_longer_than_the_step_is_waited_for(learning):
    begun, let_go = threading.Event(), threading.Event()

    def held_up(batch, beta):
        begun.set()
        assert let_go.wait(10.0)
        return losses(1.0)

    learning.learner.update = held_up
    assert learning.finish() == 0.0  # nothing was begun
    learning.begin(0.0)
    assert begun.wait(10.0)
    threading.Timer(0.02, let_go.set).start()
    waited_s = learning.finish()
    episode = learning.end_episode(0.0)
    assert episode.waiting_s == waited_s > 0.0
    assert episode.learning_s > 0.0


def test_the_policy_acts_and_learns_in_one_thread_that_ends_with_it(learning):
    threads = []

    def update(batch, beta):
        threads.append(threading.current_thread())
        return losses(1.0)

    def act(seen):
        threads.append(threading.current_thread())
        return np.zeros(1, np.float32)

    learning.learner.update, learning.learner.act = update, act
    learning.act(PICTURE)
    learning.begin(0.0)
    learning.finish()
    assert len(threads) == 2
    (thread,) = set(threads)
    assert thread is not threading.current_thread()
    assert thread.is_alive()
    learning.close()
    assert not thread.is_alive()


def test_validation_acts_in_the_learners_thread(tmp_path):
    run = scripted_run(
        tmp_path, replace(CONFIG, evaluate_every_steps=1, evaluation_runs=2), length=3
    )
    run.validation.envs = [ScriptedEnv(3, "goal") for _ in range(2)]
    learner, threads = run.learning.learner, []
    act = learner.act

    def spy(seen):
        threads.append(threading.current_thread())
        return act(seen)

    def spy_together(seen, averaged):
        threads.append(threading.current_thread())
        return np.zeros((len(seen), 1), np.float32)

    learner.act, learner.act_together = spy, spy_together
    validations = []
    run.train(lambda metrics: validations.append(metrics.validation_distance_m))
    assert validations == [3.0]
    assert len(threads) == 3 + 3  # two episodes of three steps, side by side
    assert len(set(threads)) == 1
    assert threads[0] is not threading.current_thread()


def test_an_update_runs_beside_the_step_and_knows_what_was_stored_before_it(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=4)
    begun, moved, learner, env = threading.Event(), threading.Event(), run.learning.learner, run.env
    update, step, known = learner.update, env.step, []

    def slow_update(batch, beta):
        begun.set()
        assert moved.wait(10.0)  # so it is still at work when the environment is done
        known.append(len(run.stored))
        return update(batch, beta)

    def step_beside(action):
        if run.stored:
            assert begun.wait(10.0)
        moved.set()
        return step(action)

    learner.update, env.step = slow_update, step_beside
    run.train()
    assert known == [1, 2, 3]


def test_an_environment_that_fails_beside_an_update_ends_the_run_and_the_thread(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=9)
    update, step, threads = run.learning.learner.update, run.env.step, []

    def spy(batch, beta):
        threads.append(threading.current_thread())
        return update(batch, beta)

    def failing(action):
        if len(run.stored) == 2:
            raise RuntimeError("the road is gone")
        return step(action)

    run.learning.learner.update, run.env.step = spy, failing
    with pytest.raises(RuntimeError, match="the road is gone"):
        run.train()
    # The last update ran to its end, and nobody took its priorities.
    assert (len(run.learned), len(run.written), len(run.stored)) == (2, 1, 2)
    assert not threads[0].is_alive()


def test_an_update_that_fails_reaches_the_caller_and_ends_the_thread(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=9)
    threads = []

    def failing(batch, beta):
        threads.append(threading.current_thread())
        raise RuntimeError("no memory is left")

    run.learning.learner.update = failing
    with pytest.raises(RuntimeError, match="no memory"):
        run.train()
    assert (len(run.env.actions), len(run.stored)) == (2, 1)
    assert len(threads) == 1
    assert not threads[0].is_alive()


def test_each_second_of_a_control_period_is_counted_where_it_is_spent(tmp_path, monkeypatch):
    """On a clock that stands still but for what is said to take time."""
    run = scripted_run(tmp_path, CONFIG, length=4)
    now_s = 0.0

    def taking(seconds, function):
        def slow(*arguments, **named):
            nonlocal now_s
            now_s += seconds
            return function(*arguments, **named)

        return slow

    def finish():
        finished()
        return 8.0

    finished, learning = run.learning.finish, run.learning
    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: now_s))
    learning.act, learning.begin = taking(1.0, learning.act), taking(2.0, learning.begin)
    run.env.step = taking(4.0, run.env.step)
    learning.finish, learning.add = taking(8.0 + 16.0, finish), taking(32.0, learning.add)
    metrics = run.advance()
    learning.close()
    assert metrics.acting_s == 4 * 1.0
    assert metrics.environment_s == 4 * 4.0
    assert metrics.storing_s == 3 * 2.0 + 4 * (16.0 + 32.0)  # the first step begins no update
