import math
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from hil_tests.processes import wait_until
from trainer.learner.config import ALGORITHMS, LearnerConfig
from trainer.learner.networks import Actor
from trainer.person.run import BehindTheScenes, Check, PersonRun, UnhurriedLearning
from trainer.training.config import RunConfig

CONFIG = LearnerConfig(batch_size=2, replay_capacity=50, warmup_steps=1)
SOON_S = 30.0
ACTION = np.array([0.5], np.float32)


def frames(value: int):
    return np.full((2, 45, 80), value, np.uint8)


@pytest.fixture
def unhurried(one_thread):
    unhurried = UnhurriedLearning(CONFIG, ALGORITHMS["phil_td3"], 0, 1)
    unhurried.start_episode(frames(0))
    for value in range(3):
        unhurried.add(ACTION, float(value), frames(value + 1), False, False)
    unhurried.release(discarded=False)
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
    before = unhurried.act(frames(7))
    unhurried.begin(0.0)
    for _ in range(5):
        np.testing.assert_array_equal(unhurried.act(frames(7)), before)
        unhurried.begin(0.0)
        assert unhurried.finish() == 0.0
    assert unhurried.updating
    assert gate.begun <= 1
    gate.open.set()
    unhurried.settle()
    assert np.any(unhurried.act(frames(7)) != before)


def test_an_episode_is_stored_in_its_order_after_the_update_or_not_at_all(unhurried, gate):
    unhurried.begin(0.0)
    for discarded, reward in ((True, 9.0), (False, 3.0)):
        unhurried.start_episode(frames(10))
        unhurried.add(ACTION, reward, frames(11), False, True)
        unhurried.add(-ACTION, reward + 1.0, frames(12), True, False)
        assert unhurried.added == 3
        if discarded:
            unhurried.release(discarded)
    threading.Timer(0.05, gate.open.set).start()
    unhurried.release(discarded=False)
    unhurried.release(discarded=False)
    state = unhurried.state_dict()["replay"]
    assert state["rewards"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert state["human"].tolist() == [False, False, False, True, False]
    assert state["terminals"].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


def test_the_next_update_begins_when_the_last_is_done(unhurried, gate):
    gate.open.set()
    for _ in range(3):
        unhurried.begin(0.0)
        wait_until(lambda: not unhurried.updating, "the update's end")
    unhurried.settle()
    assert gate.begun == 3


def test_what_an_update_raises_comes_out(unhurried, monkeypatch):
    fail = Mock(side_effect=RuntimeError("no more memory"))
    monkeypatch.setattr(unhurried.learner, "update", fail)
    unhurried.begin(0.0)
    with pytest.raises(RuntimeError, match="no more memory"):
        unhurried.settle()


def test_a_restored_learner_acts_as_the_one_that_was_saved(unhurried):
    unhurried.begin(0.0)
    unhurried.settle()
    state, action = unhurried.state_dict(), unhurried.act(frames(7))
    other = UnhurriedLearning(CONFIG, ALGORITHMS["phil_td3"], 5, 1)
    assert np.any(other.act(frames(7)) != action)
    other.load_state_dict(state)
    np.testing.assert_array_equal(other.act(frames(7)), action)
    other.close()


def test_a_validation_whose_process_is_killed_is_let_be_and_the_next_is_none_either(capsys):
    behind = BehindTheScenes(RunConfig())
    for _ in range(2):
        behind.begin(Check(Actor(), 1, 0.0, {}))
        behind.kill()
        wait_until(lambda: not behind.busy, "the answer's absence")
        assert behind.take() is None
    behind.close()
    assert capsys.readouterr().err.count("no validation beside the drive") == 1


SCRIPT = """
from trainer.learner.networks import Actor
from trainer.person.run import BehindTheScenes, Check
from trainer.training.config import RunConfig

print(f"this is {__name__}")
behind = BehindTheScenes(RunConfig(evaluation_runs=1))
behind.begin(Check(Actor(), 1, 0.0, {}))
while behind.busy:
    pass
print(f"{len(behind.take()[1])} drive")
behind.close()
"""


def test_a_script_that_trains_is_not_run_again_by_its_validation(tmp_path):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    ran = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=100)
    assert (ran.stdout, ran.stderr) == ("this is __main__\n1 drive\n", "")


@pytest.mark.parametrize(
    ("added", "loss", "said"),
    [
        (0, math.nan, "not learning yet (0 of 256 steps)"),
        (255, math.nan, "not learning yet (255 of 256 steps)"),
        (256, math.nan, "critic loss –"),
        (900, 0.1239, "critic loss 0.124"),
    ],
)
def test_before_it_learns_it_says_so_instead_of_nan(added, loss, said):
    run: Any = SimpleNamespace(config=RunConfig(), learning=SimpleNamespace(added=added))
    assert PersonRun._learned(run, loss) == said
