"""The loop on a scripted road, with a scripted human and a learner that only listens."""

import math
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from hil_tests.testing.commands import refusal
from trainer.drivers import CHECKPOINT_FILE
from trainer.human.guide import Intervention
from trainer.learner import equations
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import Losses
from trainer.scenarios.left_turn import LeftTurnEnv
from trainer.training.config import RunConfig
from trainer.training.delayed import DelayedPolicy
from trainer.training.metrics import MetricsWriter
from trainer.training.run import TrainingRun

POLICY, HUMAN = 0.25, -0.5
BATCH = 4
LEARNER = LearnerConfig(
    batch_size=BATCH, replay_capacity=100, warmup_steps=1, exploration_initial=0.0,
    exploration_final=0.0, intervention_penalty=-7.0,
)  # fmt: skip
CONFIG = RunConfig(episodes=1, evaluate_every_steps=0, checkpoint_every=1000, learner=LEARNER)


class ScriptedEnv:
    """Step n of an episode is rewarded with n and shows pictures of the grey value n."""

    scenario = "left_turn"
    config = SimpleNamespace(control_period_s=0.1)
    observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    brake_action = rest_action = np.array([0.0], np.float32)
    control_period_s = 0.1
    biased_action = LeftTurnEnv.biased_action

    def __init__(self, length, outcome):
        self.length, self.outcome, self.steps = length, outcome, 0
        self.actions, self.braked, self.braking = [], [], False

    def press_brake(self, pressed):
        self.braking = pressed

    def reset(self, *, seed=None):
        self.steps = 0
        return self._observation(), {"distance_m": 0.0}

    def step(self, action):
        self.steps += 1
        self.actions.append(float(action[0]))
        self.braked.append(self.braking)
        accelerations = ("lateral_acceleration_mps2", "longitudinal_acceleration_mps2")
        info = {"distance_m": float(self.steps), **dict.fromkeys(accelerations, 0.0)}
        ended, timeout = self.steps == self.length, self.outcome == "timeout"
        if ended:
            info["outcome"] = self.outcome
        ends = ended and not timeout, ended and timeout
        return self._observation(), float(self.steps), *ends, info

    def _observation(self):
        return np.full((2, 45, 80), self.steps, np.uint8)


class ScriptedGuide:
    """Acts at the given steps of each episode, counted from one."""

    def __init__(self, run, human_steps, reason):
        self.run, self.human_steps, self.reason = run, human_steps, reason
        self.asked, self.resets = [], 0

    def reset(self):
        self.resets += 1

    def watch(self, observation, action):
        self.asked.append(self.run.episode)
        step = self.run.env.steps + 1
        if step not in self.human_steps:
            return None
        first = step - 1 not in self.human_steps
        return Intervention(np.array([HUMAN], np.float32), self.reason, first)


def scripted_run(run_dir, config, length=1, outcome="goal", human_steps=(), reason="collision"):
    """A run that keeps what it ``stored``, the ``betas``, and the (indices, priorities) that it was
    given (``learned``) and wrote back (``written``)."""
    run: Any = TrainingRun(config, run_dir)
    run.env = ScriptedEnv(length, outcome)
    run.guide = ScriptedGuide(run, human_steps, reason)
    for kept in ("stored", "betas", "learned", "written", "guidance_stored"):
        setattr(run, kept, [])
    replay, learner = run.learning.replay, run.learning.learner
    add, write = replay.add, replay.update_priorities

    def spy_add(action, reward, next_frames, terminal, human, **guidance):
        assert next_frames[1, 0, 0] == run.env.steps
        run.stored.append((float(action[0]), reward, terminal, human))
        run.guidance_stored.append((float(guidance["overruled"][0]), guidance["penalised"]))
        add(action, reward, next_frames, terminal, human, **guidance)

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
    learner.actor.act = lambda seen: np.full((len(seen), 1), POLICY, np.float32)
    learner.update = update
    return run


def trained(directory, length=1, outcome="goal", human_steps=(), reason="collision", **changes):
    """A scripted run at its end, of a changed config, and what it ``told`` of its episodes."""
    learner = {name: changes.pop(name) for name in [*changes] if hasattr(LEARNER, name)}
    config = replace(CONFIG, **changes, learner=replace(LEARNER, **learner))
    run = scripted_run(directory, config, length, outcome, human_steps, reason)
    run.told = []
    run.save = lambda: None  # A checkpoint of 13 MB that nobody reads.
    run.train(run.told.append)
    return run


@pytest.mark.parametrize(
    ("algorithm", "reason", "penalise_stuck", "penalty"),
    [
        ("phil_td3", "collision", False, -7.0),
        ("phil_td3", "stuck", False, 0.0),
        ("phil_td3", "stuck", True, -7.0),
        ("phil_without_shaping", "collision", True, 0.0),
        ("rlif_td3", "collision", False, -7.0),
        ("rlif_td3", "stuck", False, -7.0),
        ("pvp_td3", "collision", True, 0.0),
        ("phil_gated", "collision", False, -7.0),
        ("phil_gated", "asked", False, 0.0),
    ],
)
@pytest.mark.parametrize("penalty_on", ["human", "overruled"])
def test_what_was_done_is_stored_and_only_taking_over_is_penalised(
    tmp_path, algorithm, reason, penalise_stuck, penalty, penalty_on
):
    config = {"penalise_stuck": penalise_stuck, "penalty_on": penalty_on, "reason": reason}
    run = trained(tmp_path, 5, human_steps=(2, 3), algorithm=algorithm, **config)
    assert [told.episode_return for told in run.told] == [15.0]  # whatever the penalty
    overruled = [(POLICY, step == 2 and penalty < 0.0) for step in range(1, 6)]
    assert run.guidance_stored == overruled
    penalty = penalty if penalty_on == "human" else 0.0
    paid = 0.0 if algorithm in ("rlif_td3", "pvp_td3") else 1.0  # these have no reward
    assert run.stored == [
        (POLICY, 1.0 * paid, False, False),
        (HUMAN, 2.0 * paid + penalty, False, True),
        (HUMAN, 3.0 * paid, False, True),
        (POLICY, 4.0 * paid, False, False),
        (POLICY, 5.0 * paid, True, False),
    ]
    assert run.env.actions == [action for action, *_ in run.stored]


@pytest.mark.parametrize(
    ("outcome", "terminal"), [("goal", True), ("collision", True), ("timeout", False)]
)
def test_a_timeout_ends_the_episode_but_is_not_terminal(tmp_path, outcome, terminal):
    run = trained(tmp_path, 2, outcome, episodes=2)
    assert [stored[2] for stored in run.stored] == [False, terminal] * 2


@pytest.mark.parametrize(("warmup_steps", "updates"), [(1, 4), (4, 2)])
def test_learning_waits_for_the_warmup_and_writes_each_updates_priorities_back(
    tmp_path, warmup_steps, updates
):
    run = trained(tmp_path, updates + warmup_steps, warmup_steps=warmup_steps)
    assert len(run.learned) == updates
    assert run.written == run.learned


@pytest.mark.parametrize(("sampling", "betas"), [(True, [0.6, 0.4, 0.2]), (False, [0.0] * 3)])
def test_beta_falls_to_zero_over_the_episodes(tmp_path, sampling, betas):
    run = trained(tmp_path, episodes=4, importance_sampling=sampling, beta=0.8)
    assert run.betas == pytest.approx(betas)


def test_learning_rates_fall_once_an_episode(tmp_path):
    learner = replace(LEARNER, actor_learning_rate=2e-4, learning_rate_decay=0.9)
    run = scripted_run(tmp_path, replace(CONFIG, episodes=2, learner=learner), length=3)
    rates, group = [], run.learning.learner.actor_optimiser.param_groups[0]
    run.train(lambda metrics: rates.append(group["lr"]))
    assert rates == pytest.approx([2e-4 * 0.9, 2e-4 * 0.81 / 2])


def test_exploration_falls_to_its_floor(tmp_path, monkeypatch):
    """With noise as large as its deviation, the actions show the deviation that was used."""

    def noise(scale, bound, drawn):
        return np.full(len(drawn), scale, np.float32)

    monkeypatch.setattr(equations, "exploration_noise", noise)
    falling = {"exploration_initial": 0.5, "exploration_share": 0.4, "exploration_final": 0.1}
    run, stds = trained(tmp_path, episodes=5, **falling), [0.5, 0.3, 0.1, 0.1, 0.1]
    assert [told.exploration_std for told in run.told] == pytest.approx(stds)
    assert run.env.actions == pytest.approx([POLICY + std for std in stds])


def test_a_human_at_the_wheel_does_not_drive_against_the_brake_of_a_silent_network(tmp_path):
    config = replace(CONFIG, latency="up.loss=100%")
    run = scripted_run(tmp_path, config, length=7, human_steps=(4, 5))
    run.policy = DelayedPolicy(run.learning, run.env, run.network)
    run.train()
    assert run.env.braked == [False, False, True, False, False, True, True]


def test_the_human_watches_its_share_of_the_episodes(tmp_path):
    run = trained(tmp_path, 2, human_steps=(2,), episodes=7, guided_share=1 / 3)
    assert (run.guide.asked, run.guide.resets) == ([0, 0, 3, 3, 6, 6], 7)
    guided, alone = [False, True], [False, False]
    assert [human for *_, human in run.stored] == (guided + 2 * alone) * 2 + guided


@given(st.floats(0.0, 1.0), st.integers(1, 300))
def test_the_share_of_watched_episodes_is_met_at_any_time(share, episodes):
    config = replace(CONFIG, guided_share=share)
    watched = sum(config.guided(episode, 0) for episode in range(episodes))
    assert watched == math.ceil(episodes * share)


@pytest.mark.parametrize("until", [{"guided_until_step": 3}, {"guided_until_episode": 2}])
def test_the_human_leaves_after_so_many_steps_or_episodes(tmp_path, until):
    run = trained(tmp_path, 2, human_steps=(2,), episodes=4, **until)
    assert [human for *_, human in run.stored] == [False, True] * 2 + [False] * 4


def test_a_budget_in_steps_ends_the_run_with_the_episode_under_way(tmp_path):
    run = trained(tmp_path, 2, episodes=100, steps=5)
    assert (run.episode, run.steps) == (3, 6)


def test_validation_is_due_by_environment_steps(tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=6, evaluate_every_steps=5), length=3)
    judged: list[int] = []
    run.validation.judge = lambda metrics, episode, due: judged.append(episode)
    run.train()
    assert judged == [2, 4, 5, 6]


def poorly_guided(tmp_path, **how):
    """The 600 actions of a run in which the human drives throughout."""
    run = trained(tmp_path, 200, human_steps=range(1, 201), episodes=3, **how)
    assert all(human for *_, human in run.stored)
    return np.array([action for action, *_ in run.stored])


def test_poor_guidance_replaces_its_share_of_the_demonstrations(tmp_path):
    """By random actions, or by the same wrong one."""
    done = poorly_guided(tmp_path, poor_guidance_share=1 / 3)
    poor = done[done != np.float32(HUMAN)]
    assert len(poor) == pytest.approx(200, abs=40)
    assert np.abs(poor).max() <= 1.0
    assert np.std(poor) == pytest.approx(3**-0.5, abs=0.08)  # uniform over the whole range
    done = poorly_guided(tmp_path, poor_guidance_share=0.5, poor_guidance="biased")
    assert set(done) == {HUMAN, LeftTurnEnv.biased_action}
    assert (done == HUMAN).sum() == pytest.approx(300, abs=60)


def bad_update(run):
    run.learning.learner.update = lambda *_: Losses(0.0, 0.0, 0.0, 0.0, np.full(BATCH, np.nan))


def bad_action(run):
    run.learning.learner.actor.act = lambda _: np.array([[np.nan]], np.float32)


def bad_weights(run):
    with torch.no_grad():
        next(run.learning.learner.target_critics.parameters()).fill_(torch.inf)


@pytest.mark.parametrize("spoil", [bad_update, bad_action, bad_weights])
def test_it_ends_where_it_shows_and_the_checkpoint_stays(spoil, tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=3), length=4)
    with closing(MetricsWriter(tmp_path)) as metrics:
        metrics.add(run.advance())
    run.save()
    before = (tmp_path / CHECKPOINT_FILE).read_bytes()
    spoil(run)
    with pytest.raises(UserError, match="the training diverged in episode 2: its"):
        run.train()
    assert all(np.isfinite(run.env.actions))
    assert (tmp_path / CHECKPOINT_FILE).read_bytes() == before


def test_the_command_ends_with_one_line(capsys, tmp_path, one_thread):
    settings = ("actor_learning_rate=1e30", "warmup_steps=10", "batch_size=4", "precision=float32")
    chosen = [part for setting in settings for part in ("--set", setting)]
    with np.errstate(all="raise"):
        err = refusal(capsys, "train", "--episodes", "1", "--out", str(tmp_path), *chosen)
    assert "the training diverged in episode 1" in err
    assert "a smaller --set actor_learning_rate" in err
