"""The loop on a scripted road: what is stored, when it learns, validates and ends."""

import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from trainer.evaluation import CHECKPOINT_FILE
from trainer.learner.td3 import Losses
from trainer.tests.loops import BATCH, CONFIG, HUMAN, POLICY, number, scripted_run, trained
from trainer.training.metrics import MetricsWriter


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
    paid = 0.0 if algorithm in ("rlif_td3", "pvp_td3") else 1.0  # these have no reward
    charged = penalty if penalty_on == "human" else 0.0
    for step, stored in enumerate(run.stored, start=1):
        human = step in (2, 3)
        assert (number(stored.observation), number(stored.next_observation)) == (step - 1, step)
        assert stored.action[0] == (HUMAN if human else POLICY)
        assert (stored.overruled[0], stored.human) == (POLICY, human)
        assert stored.penalised == (step == 2 and penalty < 0.0)
        assert stored.reward == step * paid + charged * (step == 2)
        assert stored.terminal == (step == 5)
    assert run.env.actions == [stored.action[0] for stored in run.stored]


@pytest.mark.parametrize(
    ("outcome", "terminal"), [("goal", True), ("collision", True), ("timeout", False)]
)
def test_a_timeout_ends_the_episode_but_is_not_terminal(tmp_path, outcome, terminal):
    run = trained(tmp_path, 2, outcome, episodes=2)
    assert [stored.terminal for stored in run.stored] == [False, terminal] * 2
    assert [stored.truncated for stored in run.stored] == [False, not terminal] * 2


@pytest.mark.parametrize(("warmup_steps", "updates"), [(1, 4), (4, 2)])
def test_learning_waits_for_the_warmup_and_writes_each_updates_priorities_back(
    tmp_path, warmup_steps, updates
):
    run = trained(tmp_path, updates + warmup_steps, warmup_steps=warmup_steps)
    assert len(run.learned) == updates
    assert run.written == run.learned


def test_a_human_at_the_wheel_does_not_drive_against_the_brake_of_a_silent_network(tmp_path):
    run = trained(tmp_path, 7, human_steps=(4, 5), latency="up.loss=100%")
    assert run.env.braked == [False, False, True, False, False, True, True]


@given(st.floats(0.0, 1.0), st.integers(1, 300))
def test_the_share_of_watched_episodes_is_met_at_any_time(share, episodes):
    config = replace(CONFIG, guided_share=share)
    watched = sum(config.guided(episode, 0) for episode in range(episodes))
    assert watched == math.ceil(episodes * share)


@pytest.mark.parametrize("until", [{"guided_until_step": 3}, {"guided_until_episode": 2}])
def test_the_human_leaves_after_so_many_steps_or_episodes(tmp_path, until):
    run = trained(tmp_path, 2, human_steps=(2,), episodes=4, **until)
    assert [stored.human for stored in run.stored] == [False, True] * 2 + [False] * 4


def test_a_budget_in_steps_ends_the_run_with_the_episode_under_way(tmp_path):
    run = trained(tmp_path, 2, episodes=100, steps=5)
    assert (run.episode, run.steps) == (3, 6)


def bad_update(run):
    run.learning.learner.update = lambda *_: Losses(0.0, 0.0, 0.0, 0.0, np.full(BATCH, np.nan))


def bad_action(run):
    run.learning.learner.actor.act = lambda _: np.array([[np.nan]], np.float32)


def bad_weights(run):
    with torch.no_grad():
        next(run.learning.learner.target_critics.parameters()).fill_(torch.inf)


@pytest.mark.parametrize("spoil", [bad_update, bad_action, bad_weights])
def test_divergence_ends_the_run_where_it_shows_and_the_checkpoint_stays(spoil, tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=3), length=4)
    with closing(MetricsWriter(tmp_path)) as metrics:
        metrics.add(run.advance())
    run.save()
    before = (tmp_path / CHECKPOINT_FILE).read_bytes()
    spoil(run)
    with pytest.raises(UserError, match="diverged in episode 2"):
        run.train()
    assert all(np.isfinite(run.env.actions))
    assert (tmp_path / CHECKPOINT_FILE).read_bytes() == before
