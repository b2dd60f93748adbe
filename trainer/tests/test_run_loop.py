"""The training loop around a scripted road, human and learner, and where the learner diverges."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bridge.network import parse_spec
from edge_runtime.util import UserError
from trainer.drivers import CHECKPOINT_FILE
from trainer.learner import equations
from trainer.learner.td3 import Losses
from trainer.tests.scripted import BATCH, CONFIG, HUMAN, LEARNER, POLICY, scripted_run
from trainer.tests.test_commands import refusal
from trainer.training.delayed import behind
from trainer.training.run import WRONG_ACTIONS


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
@pytest.mark.parametrize("penalty_on", ["human", "overruled"])
def test_what_was_done_is_stored_and_only_taking_over_is_penalised(
    tmp_path, algorithm, reason, penalise_stuck, penalty, penalty_on
):
    config = replace(
        CONFIG,
        algorithm=algorithm,
        penalise_stuck=penalise_stuck,
        learner=replace(LEARNER, penalty_on=penalty_on),
    )
    run = scripted_run(tmp_path, config, length=5, human_steps=(2, 3), reason=reason)
    returns: list[float] = []
    run.train(lambda metrics: returns.append(metrics.episode_return))
    assert returns == [15.0]  # what the road paid, whatever the penalty
    overruled = [(POLICY, step == 2 and penalty < 0.0) for step in range(1, 6)]
    assert run.guidance_stored == overruled
    penalty = penalty if penalty_on == "human" else 0.0
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


def test_learning_rates_fall_once_an_episode(tmp_path):
    learner = replace(LEARNER, actor_learning_rate=2e-4, learning_rate_decay=0.9)
    run = scripted_run(tmp_path, replace(CONFIG, episodes=2, learner=learner), length=3)
    rates = []
    run.train(
        lambda metrics: rates.append(run.learning.learner.actor_optimiser.param_groups[0]["lr"])
    )
    assert rates == pytest.approx([2e-4 * 0.9, 2e-4 * 0.81 / 2])


def test_exploration_falls_to_its_floor(tmp_path, monkeypatch):
    """With noise as large as its deviation, the actions show the deviation that was used."""
    monkeypatch.setattr(
        equations,
        "exploration_noise",
        lambda scale, bound, drawn: np.full(len(drawn), scale, np.float32),
    )
    learner = replace(
        LEARNER, exploration_initial=0.5, exploration_share=0.4, exploration_final=0.1
    )
    run = scripted_run(tmp_path, replace(CONFIG, episodes=5, learner=learner))
    reported: list[float] = []
    run.train(lambda metrics: reported.append(metrics.exploration_std))
    stds = [0.5, 0.3, 0.1, 0.1, 0.1]
    assert reported == pytest.approx(stds)
    assert run.env.actions == pytest.approx([POLICY + std for std in stds])


def test_a_human_at_the_wheel_does_not_drive_against_the_brake_of_a_silent_network(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=7, human_steps=(4, 5))
    run.policy = behind(parse_spec("up.loss=100%"), run.learning, run.env)
    run.train()
    assert run.env.braked == [False, False, True, False, False, True, True]


def test_the_human_watches_its_share_of_the_episodes(tmp_path):
    config = replace(CONFIG, episodes=7, guided_share=1 / 3)
    run = scripted_run(tmp_path, config, length=2, human_steps=(2,))
    run.train()
    assert run.guide.asked == [0, 0, 3, 3, 6, 6]
    assert run.guide.resets == 7
    assert [human for *_, human in run.stored] == [
        step == 2 and episode % 3 == 0 for episode in range(7) for step in (1, 2)
    ]


@given(st.floats(0.0, 1.0), st.integers(1, 300))
def test_the_share_of_watched_episodes_is_met_at_any_time(share, episodes):
    config = replace(CONFIG, guided_share=share)
    watched = sum(config.guided(episode, 0) for episode in range(episodes))
    assert watched == math.ceil(episodes * share)


def test_the_human_leaves_after_so_many_steps(tmp_path):
    config = replace(CONFIG, episodes=4, guided_until_step=3)
    run = scripted_run(tmp_path, config, length=2, human_steps=(2,))
    run.train()
    assert [human for *_, human in run.stored] == [False, True] * 2 + [False] * 4


def test_a_budget_in_steps_ends_the_run_with_the_episode_under_way(tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=100, steps=5), length=2)
    run.train()
    assert (run.episode, run.steps) == (3, 6)


def test_validation_is_due_by_environment_steps(tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=6, evaluate_every_steps=5), length=3)
    judged: list[int] = []
    run.validation.judge = lambda metrics, episode, due: judged.append(episode)
    run.train()
    assert judged == [2, 4, 5, 6]


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


def test_biased_guidance_replaces_its_share_by_the_same_wrong_action(tmp_path):
    config = replace(CONFIG, poor_guidance_share=0.5, poor_guidance="biased")
    run = scripted_run(tmp_path, config, length=200, human_steps=tuple(range(1, 201)))
    run.train()
    done = [action for action, *_ in run.stored]
    assert set(done) == {HUMAN, WRONG_ACTIONS["left_turn"]}
    assert done.count(HUMAN) == pytest.approx(100, abs=30)


SAID = "the training diverged in episode 2: its"


def begun(tmp_path):
    """A run after its first episode, with a checkpoint."""
    run = scripted_run(tmp_path, replace(CONFIG, episodes=3), length=4)
    run.advance()
    run.save()
    return run, (tmp_path / CHECKPOINT_FILE).read_bytes()


def bad_update(run):
    run.learning.learner.update = lambda *_: Losses(0.0, 0.0, 0.0, 0.0, np.full(BATCH, np.nan))


def bad_action(run):
    run.learning.learner.act = lambda *_: np.array([np.nan], np.float32)


def bad_weights(run):
    with torch.no_grad():
        next(run.learning.learner.target_critics.parameters()).fill_(torch.inf)


@pytest.mark.parametrize("spoil", [bad_update, bad_action, bad_weights])
def test_it_ends_where_it_shows_and_the_checkpoint_stays(spoil, tmp_path):
    run, before = begun(tmp_path)
    spoil(run)
    with pytest.raises(UserError, match=SAID):
        run.train()
    assert all(np.isfinite(run.env.actions))
    assert (tmp_path / CHECKPOINT_FILE).read_bytes() == before


def test_the_command_ends_with_one_line(capsys, tmp_path, one_thread):
    settings = ("actor_learning_rate=1e30", "warmup_steps=10", "batch_size=4", "precision=float32")
    chosen = [part for setting in settings for part in ("--set", setting)]
    command = ["train", "--episodes", "1", "--out", str(tmp_path), *chosen]
    with np.errstate(all="raise"):
        err = refusal(capsys, *command)
    assert "the training diverged in episode 1" in err
    assert "a smaller --set actor_learning_rate" in err
