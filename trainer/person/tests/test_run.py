"""A validation beside a person, and what a kill had taken from a run with one."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
from msgspec import structs

from hil_tests.processes import wait_until
from trainer.human.guide import Guide
from trainer.learner.config import LearnerConfig
from trainer.learner.networks import Actor
from trainer.person import run as person_run
from trainer.person.recording import DIRECTORY
from trainer.person.run import PersonValidation
from trainer.person.tests.people import record, recorded_step
from trainer.tests.loops import ScriptedEnv
from trainer.training.config import RunConfig
from trainer.training.learning import UnhurriedLearning
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun, Validation


def test_a_validation_whose_process_is_killed_is_let_be_and_the_next_is_none_either(
    capsys, tmp_path
):
    learning: Any = SimpleNamespace(learner=SimpleNamespace(target_actor=Actor()))
    validation = PersonValidation(RunConfig(), tmp_path, learning, Mock())
    metrics = EpisodeMetrics(0, updates=1)
    for _ in range(2):
        validation._beside(metrics, 1, due=True)
        for process in (validation._process._processes or {}).values():
            process.kill()
        if validation._begun:
            wait_until(validation._begun[2].done, "the answer's absence")
        validation._beside(metrics, 2, due=False)
    validation.close()
    assert np.isnan(metrics.validation_success)
    assert capsys.readouterr().err.count("no validation beside the drive") == 1


def episode(first: int, length: int, human: range, **last: Any):
    """A recorded episode whose steps in ``human`` are the person's."""
    steps = [
        recorded_step(
            1, first + step, step=step, action=0.1 * step, human=step in human,
            first=step == human.start and step in human, terminated=step == length - 1,
        )
        for step in range(length)
    ]  # fmt: skip
    return [*steps[:-1], structs.replace(steps[-1], **last)]


def recovered(tmp_path, steps, **settings: Any) -> TrainingRun:
    """A run that goes on from its beginning, with what was recorded since."""
    record(tmp_path / DIRECTORY, steps)
    small = LearnerConfig(replay_capacity=100, penalty_on="human")
    config = RunConfig(learner=small, **settings)
    env: Any = ScriptedEnv()
    sitting: Any = SimpleNamespace(saved_at=(0, 0))
    learning = UnhurriedLearning(config, env)
    validation = Validation(config, tmp_path, learning, env)
    parts = env, Guide(), learning, validation
    training: Any = TrainingRun(config, tmp_path, False, *parts)
    person_run._recover(training, sitting)
    learning.close()
    return training


STEPS = [*episode(0, 4, range(1, 3)), *episode(4, 3, range(0))]


def test_steps_come_back_with_mask_action_reward_and_pictures(tmp_path, capsys):
    replay = recovered(tmp_path, STEPS).learning.replay
    assert "7 recorded steps after the checkpoint, 2 of them yours" in capsys.readouterr().err
    state = replay.state_dict()
    assert state["human"].tolist() == [False, True, True, False, False, False, False]
    assert state["rewards"].tolist() == [0.0, 1.0 - 10.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert state["terminals"].tolist() == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    assert state["penalised"].tolist() == [False, True, False, False, False, False, False]
    assert state["overruled"][:, 0].tolist() == [step.policy_action for step in STEPS]
    batch = replay.sample(200, np.random.default_rng(0))
    for row, index in enumerate(batch.indices):
        assert batch.frames[row].tobytes() == STEPS[index].observation.tobytes()


def test_behind_a_network_the_action_answers_an_older_picture(tmp_path):
    steps = episode(0, 5, range(0))
    replay = recovered(tmp_path, steps, latency="100ms").learning.replay
    assert replay.state_dict()["rewards"].tolist() == [2.0, 3.0, 4.0]
    batch = replay.sample(50, np.random.default_rng(0))
    for row, index in enumerate(batch.indices):
        assert batch.frames[row].tobytes() == steps[index].observation.tobytes()
