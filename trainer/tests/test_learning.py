"""The learner's thread beside a control period, and one that is never waited for."""

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainer.learner.config import LearnerConfig
from trainer.learner.replay import Transition
from trainer.tests.loops import CONFIG, ScriptedEnv, scripted_run
from trainer.training.config import RunConfig
from trainer.training.learning import UnhurriedLearning

PICTURE = np.random.default_rng(1).integers(0, 255, (2, 45, 80)).astype(np.uint8)
SOON_S = 30.0


def transition(reward: float = 0.0, action: float = 0.5, **more: Any) -> Transition:
    done = more.pop("terminal", False)
    return Transition(PICTURE, np.full(1, action, np.float32), reward, PICTURE, done, **more)


def noting(threads, function):
    """The same, which notes in which thread it is called."""

    def noted(*arguments):
        threads.append(threading.current_thread())
        return function(*arguments)

    return noted


def test_an_update_runs_beside_the_step_and_knows_what_was_stored_before_it(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=4)
    begun, moved, known = threading.Event(), threading.Event(), []
    update, step = run.learning.learner.update, run.env.step

    def slow_update(batch, beta):
        begun.set()
        assert moved.wait(10.0)  # so it is still at work when the environment is done
        known.append(len(run.stored))
        return update(batch, beta)

    def step_beside(action):
        assert not run.stored or begun.wait(10.0)
        moved.set()
        return step(action)

    run.learning.learner.update, run.env.step = slow_update, step_beside
    run.train()
    assert known == [1, 2, 3]


def test_what_fails_beside_an_update_ends_the_run_and_the_thread(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=9)
    threads: list[threading.Thread] = []
    step = run.env.step

    def failing(action):
        if len(run.stored) == 2:
            raise RuntimeError("the road is gone")
        return step(action)

    run.learning.learner.update = noting(threads, run.learning.learner.update)
    run.env.step = failing
    with pytest.raises(RuntimeError, match="the road is gone"):
        run.train()
    # The last update ran to its end, and nobody took its priorities.
    assert (len(run.learned), len(run.written), len(run.stored)) == (2, 1, 2)
    assert not threads[0].is_alive()


@pytest.fixture
def unhurried(one_thread):
    config = RunConfig(learner=LearnerConfig(batch_size=2, replay_capacity=50, warmup_steps=1))
    unhurried = UnhurriedLearning(config, ScriptedEnv())
    for reward in range(3):
        unhurried.add(transition(float(reward)))
    unhurried.release()
    yield unhurried
    unhurried.close()


@pytest.fixture
def gate(unhurried, monkeypatch):
    """Updates are held up until it is open."""
    learner, gate = unhurried.learner, SimpleNamespace(open=threading.Event(), begun=0)
    update = learner.update

    def held_up(batch, beta=0.0):
        gate.begun += 1
        assert gate.open.wait(SOON_S)
        return update(batch, beta)

    monkeypatch.setattr(learner, "update", held_up)
    return gate


def test_while_an_update_hangs_everything_goes_on(unhurried, gate):
    before = unhurried.act(PICTURE)
    unhurried.begin(0.0)
    for _ in range(5):
        np.testing.assert_array_equal(unhurried.act(PICTURE), before)
        unhurried.begin(0.0)
        assert unhurried.finish() == 0.0
    assert unhurried.updating
    assert gate.begun <= 1
    gate.open.set()
    unhurried.settle()
    assert np.any(unhurried.act(PICTURE) != before)


def test_an_episode_is_stored_in_its_order_after_the_update_or_not_at_all(unhurried, gate):
    unhurried.begin(0.0)
    for keep, reward in ((False, 9.0), (True, 3.0)):
        unhurried.add(transition(reward, human=True))
        unhurried.add(transition(reward + 1.0, terminal=True))
        assert unhurried.added == 3
        if not keep:
            threading.Timer(0.05, gate.open.set).start()
        unhurried.end_episode(0.0, keep)
    unhurried.release()
    state = unhurried.state_dict()["replay"]
    assert state["rewards"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert state["human"].tolist() == [False, False, False, True, False]
    assert state["terminals"].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]
