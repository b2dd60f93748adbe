"""The training loop around a scripted road, a scripted human and a learner that only listens."""

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from trainer.human.guide import Intervention
from trainer.human.trigger import Reason
from trainer.learner import equations
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import Losses
from trainer.training.config import RunConfig
from trainer.training.run import TrainingRun

POLICY, HUMAN = 0.25, -0.5
BATCH = 4
LEARNER = LearnerConfig(
    batch_size=BATCH,
    replay_capacity=100,
    warmup_steps=1,
    exploration_initial=0.0,
    exploration_final=0.0,
    intervention_penalty=-7.0,
)
CONFIG = RunConfig(episodes=1, evaluate_every=0, checkpoint_every=1000, learner=LEARNER)


class ScriptedEnv:
    """Step n of an episode is rewarded with n and shows pictures of the grey value n."""

    scenario = "left_turn"
    config = SimpleNamespace(control_period_s=0.1)
    observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int, outcome: str) -> None:
        self.length, self.outcome = length, outcome
        self.steps = 0
        self.actions: list[float] = []

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.steps = 0
        return self._observation(), {"distance_m": 0.0}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.actions.append(float(action[0]))
        info: dict[str, Any] = {"distance_m": float(self.steps)}
        ended, timeout = self.steps == self.length, self.outcome == "timeout"
        if ended:
            info["outcome"] = self.outcome
        terminated, truncated = ended and not timeout, ended and timeout
        return self._observation(), float(self.steps), terminated, truncated, info

    def _observation(self) -> np.ndarray:
        return np.full((2, 45, 80), self.steps, np.uint8)


class ScriptedGuide:
    """Acts at the given steps of each episode, counted from one."""

    def __init__(self, run: Any, human_steps: tuple[int, ...], reason: Reason) -> None:
        self.run, self.human_steps, self.reason = run, human_steps, reason
        self.asked: list[int] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def watch(self, observation: np.ndarray, action: np.ndarray) -> Intervention | None:
        self.asked.append(self.run.episode)
        step = self.run.env.steps + 1
        if step not in self.human_steps:
            return None
        first = step - 1 not in self.human_steps
        return Intervention(np.array([HUMAN], np.float32), self.reason, first)


def scripted_run(
    run_dir: Path,
    config: RunConfig,
    length: int = 1,
    outcome: str = "goal",
    human_steps: tuple[int, ...] = (),
    reason: Reason = "collision",
) -> Any:
    """A run that also keeps what it ``stored``, the ``betas`` and the priorities it was given
    (``learned``) and wrote back (``written``); each of the last two as (indices, priorities).
    """
    run: Any = TrainingRun(config, run_dir)
    run.env = ScriptedEnv(length, outcome)
    run.guide = ScriptedGuide(run, human_steps, reason)
    run.stored, run.betas, run.learned, run.written = [], [], [], []
    replay, learner = run.learning.replay, run.learning.learner
    add, write = replay.add, replay.update_priorities

    def spy_add(action, reward, next_frames, terminal, human):
        assert next_frames[1, 0, 0] == run.env.steps
        run.stored.append((float(action[0]), reward, terminal, human))
        add(action, reward, next_frames, terminal, human)

    def spy_write(indices, priorities):
        # The buffer itself writes one at a time.
        if len(indices) == BATCH:
            run.written.append((indices.tolist(), priorities.tolist()))
        write(indices, priorities)

    def update(batch, beta):
        priorities = 2.0 + len(run.betas) + np.arange(BATCH) / 8
        run.betas.append(beta)
        run.learned.append((batch.indices.tolist(), priorities.tolist()))
        return Losses(0.0, 0.0, 0.0, 0.0, priorities)

    replay.add, replay.update_priorities = spy_add, spy_write
    learner.act = lambda observation: np.array([POLICY], np.float32)
    learner.update = update
    return run


@pytest.mark.parametrize(
    ("algorithm", "reason", "penalise_stuck", "penalty"),
    [
        ("phil_td3", "collision", False, -7.0),
        ("phil_td3", "collision", True, -7.0),
        ("phil_td3", "stuck", False, 0.0),
        ("phil_td3", "stuck", True, -7.0),
        ("phil_without_shaping", "collision", True, 0.0),
        ("phil_without_shaping", "stuck", True, 0.0),
    ],
)
def test_what_was_done_is_stored_and_only_taking_over_is_penalised(
    tmp_path, algorithm, reason, penalise_stuck, penalty
):
    config = replace(CONFIG, algorithm=algorithm, penalise_stuck=penalise_stuck)
    run = scripted_run(tmp_path, config, length=5, human_steps=(2, 3), reason=reason)
    run.train()
    assert run.stored == [
        (POLICY, 1.0, False, False),
        (HUMAN, 2.0 + penalty, False, True),
        (HUMAN, 3.0, False, True),
        (POLICY, 4.0, False, False),
        (POLICY, 5.0, True, False),
    ]
    assert run.env.actions == [action for action, *_ in run.stored]


@pytest.mark.parametrize(
    ("outcome", "terminal"), [("goal", True), ("collision", True), ("timeout", False)]
)
def test_a_timeout_ends_the_episode_but_is_not_terminal(tmp_path, outcome, terminal):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=2), length=2, outcome=outcome)
    run.train()
    assert [stored[2] for stored in run.stored] == [False, terminal] * 2


def test_the_priorities_of_each_update_are_written_back(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=5)
    run.train()
    assert len(run.learned) == 4  # at the first step there is nothing to learn from
    assert run.written == run.learned


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


def test_learning_waits_for_the_warmup(tmp_path):
    config = replace(CONFIG, learner=replace(LEARNER, warmup_steps=4))
    run = scripted_run(tmp_path, config, length=6)
    run.train()
    assert len(run.learned) == 2


@pytest.mark.parametrize(
    ("importance_sampling", "betas"), [(True, [0.6, 0.4, 0.2]), (False, [0.0] * 3)]
)
def test_beta_falls_to_zero_over_the_episodes(tmp_path, importance_sampling, betas):
    learner = replace(LEARNER, importance_sampling=importance_sampling, beta=0.8)
    run = scripted_run(tmp_path, replace(CONFIG, episodes=4, learner=learner))
    run.train()
    assert run.betas == pytest.approx(betas)


def test_learning_rates_decay_once_an_episode(tmp_path):
    learner = replace(LEARNER, learning_rate_decay=0.9)
    run = scripted_run(tmp_path, replace(CONFIG, episodes=2, learner=learner), length=3)
    rates = []
    run.train(
        lambda metrics: rates.append(run.learning.learner.actor_optimiser.param_groups[0]["lr"])
    )
    assert rates == pytest.approx([5e-4 * 0.9, 5e-4 * 0.81])


def test_exploration_falls_to_its_floor(tmp_path, monkeypatch):
    """With noise as large as its deviation, the actions show the deviation that was used."""
    monkeypatch.setattr(
        equations,
        "exploration_noise",
        lambda scale, bound, size, random: np.full(size, scale, np.float32),
    )
    learner = replace(
        LEARNER, exploration_initial=0.5, exploration_decay=0.5, exploration_final=0.1
    )
    run = scripted_run(tmp_path, replace(CONFIG, episodes=5, learner=learner))
    reported: list[float] = []
    run.train(lambda metrics: reported.append(metrics.exploration_std))
    stds = [0.5, 0.25, 0.125, 0.1, 0.1]
    assert reported == pytest.approx(stds)
    assert run.env.actions == pytest.approx([POLICY + std for std in stds])


def test_the_human_watches_one_episode_in_guided_share(tmp_path):
    config = replace(CONFIG, episodes=7, guided_share=3)
    run = scripted_run(tmp_path, config, length=2, human_steps=(2,))
    run.train()
    assert run.guide.asked == [0, 0, 3, 3, 6, 6]
    assert run.guide.resets == 7
    assert [human for *_, human in run.stored] == [
        step == 2 and episode % 3 == 0 for episode in range(7) for step in (1, 2)
    ]


def test_poor_guidance_replaces_its_share_of_the_demonstrations_by_random_actions(tmp_path):
    config = replace(CONFIG, episodes=3, poor_guidance_share=1 / 3)
    run = scripted_run(tmp_path, config, length=200, human_steps=tuple(range(1, 201)))
    run.train()
    done = np.array([action for action, *_ in run.stored])
    poor = done[done != np.float32(HUMAN)]
    assert len(poor) == pytest.approx(200, abs=40)
    assert np.abs(poor).max() <= 1.0
    assert np.std(poor) == pytest.approx(3**-0.5, abs=0.08)  # uniform over the whole range
    assert all(human for *_, human in run.stored)
