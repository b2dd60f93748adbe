"""The paper's equations against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from trainer.learner import equations as eq


def t(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


HUMAN = torch.tensor([False, True, False, True])


def test_equation_18_the_human_has_full_authority():
    policy, human = np.array([0.3], np.float32), np.array([-1.0], np.float32)
    assert eq.masked_action(policy, None) is policy
    assert eq.masked_action(policy, human) is human


def test_equation_18b_noise_has_its_scale_and_keeps_its_bound():
    drawn = np.random.default_rng(0).standard_normal(50_000)
    noise = eq.exploration_noise(0.2, 1.0, drawn)
    assert noise.mean() == pytest.approx(0.0, abs=0.005)
    assert noise.std() == pytest.approx(0.2, rel=0.02)
    assert np.abs(eq.exploration_noise(3.0, 0.5, drawn)).max() == 0.5


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_noise_keeps_its_deviation_whatever_its_correlation(correlation):
    random, drawn = np.random.default_rng(0), np.zeros(50_000)
    series = []
    for _ in range(60):
        drawn = eq.correlated(drawn, correlation, random)
        series.append(drawn)
    assert series[-1].std() == pytest.approx(1.0, rel=0.02)
    assert np.corrcoef(series[-2], series[-1])[0, 1] == pytest.approx(correlation, abs=0.02)


@pytest.mark.parametrize(
    ("human", "before", "shaped"),
    [(True, False, -9.5), (True, True, 0.5), (False, True, 0.5), (False, False, 0.5)],
)
def test_equation_17_only_the_first_step_of_an_intervention_is_penalised(human, before, shaped):
    assert eq.shaped_reward(0.5, -10.0, human, before) == shaped


def test_target_smoothing_is_symmetric():
    action = t(0.0, 0.0, 0.9, -0.9)
    noise = t(2.0, -2.0, 0.3, -0.3)
    smoothed = eq.smoothed_target_action(action, noise, bound=0.5)
    assert smoothed.tolist() == [0.5, -0.5, 1.0, -1.0]


def test_equation_22_target_takes_the_smaller_value_and_stops_at_terminals():
    target = eq.td_target(t(1.0, 1.0), t(0.0, 1.0), (t(2.0, 5.0), t(4.0, 3.0)), gamma=0.5)
    assert target.tolist() == [1.0 + 0.5 * 2.0, 1.0]


def test_a_target_over_several_steps_bootstraps_by_its_own_power_of_gamma():
    target = eq.td_target(t(1.0, 1.0), t(0.0, 0.0), (t(4.0, 4.0), t(9.0, 9.0)), t(0.5, 0.25))
    assert target.tolist() == [3.0, 2.0]


def test_equation_17_on_the_overruled_action():
    penalised = torch.tensor([True, False, True, False])
    loss = eq.overruled_loss(t(-9.0, 5.0, -10.0, 5.0), penalised, -10.0, t(2.0, 1.0, 1.0, 1.0))
    assert loss.item() == 2.0 * 1.0 / 4


def test_equation_21b_q_advantage():
    advantage = eq.q_advantage(t(1.0, 0.0), t(0.0, 2.0), exponent_bound=4.0)
    assert advantage.tolist() == pytest.approx([math.e, math.exp(-2.0)])


def test_q_advantage_cannot_overflow():
    advantage = eq.q_advantage(t(1e6), t(-1e6), exponent_bound=4.0)
    assert advantage.item() == pytest.approx(math.exp(4.0))


def test_equation_21a_tdqa_priority():
    td_error, advantage = t(2.0, -2.0, 0.0, 0.5), t(9.0, 3.0, 9.0, 1.0)
    priority = eq.priority(td_error, advantage, HUMAN, offset=0.001)
    assert priority.tolist() == pytest.approx([2.001, 5.001, 0.001, 1.501])


def test_other_priority_schemes_are_weights():
    td_error, advantage = t(2.0, 2.0, 1.0, 1.0), t(0.0, 3.0, 0.0, 3.0)
    td_only = eq.priority(td_error, advantage, HUMAN, 0.0, 1.0, 2.0, 0.0)
    assert td_only.tolist() == [2.0, 4.0, 1.0, 2.0]
    advantage_only = eq.priority(td_error, advantage, HUMAN, 0.0, 1.0, 0.0, 1.0)
    assert advantage_only.tolist() == [2.0, 3.0, 1.0, 3.0]


def test_equation_15_importance_weights():
    probabilities = t(0.5, 0.25)
    assert eq.importance_weights(probabilities, 1.0, normalise=False).tolist() == [2.0, 4.0]
    assert eq.importance_weights(probabilities, 1.0, normalise=True).tolist() == [0.5, 1.0]
    assert eq.importance_weights(probabilities, 0.0, normalise=True).tolist() == [1.0, 1.0]


def test_equation_22_critic_loss_means_each_kind_by_itself():
    values, targets = t(0.0, 0.0, 0.0, 0.0), t(1.0, 3.0, 2.0, 1.0)
    weights = t(1.0, 1.0, 1.0, 1.0)
    # Policy: (1 + 4) / 2; human: (9 + 1) / 2.
    split = eq.critic_loss(values, targets, HUMAN, weights, split=True)
    assert split.item() == pytest.approx(2.5 + 5.0)
    whole = eq.critic_loss(values, targets, HUMAN, weights, split=False)
    assert whole.item() == pytest.approx(15.0 / 4)


def test_equation_16_weighs_each_squared_error():
    loss = eq.critic_loss(t(0.0, 0.0), t(1.0, 2.0), HUMAN[:2], t(1.0, 0.5), split=False)
    assert loss.item() == pytest.approx((1.0 + 2.0) / 2)


def test_equation_23_policy_term():
    values = t(1.0, 10.0, 3.0, 20.0)
    assert eq.policy_loss(values, HUMAN, split=True).item() == pytest.approx(-2.0)
    assert eq.policy_loss(values, HUMAN, split=False).item() == pytest.approx(-8.5)


def test_equation_23_cloning_term():
    actions = torch.tensor([[0.0], [0.5], [0.0], [-1.0]])
    human_actions = torch.tensor([[9.0], [1.0], [9.0], [1.0]])
    loss = eq.behaviour_cloning_loss(actions, human_actions, HUMAN)
    assert loss.item() == pytest.approx((0.25 + 4.0) / 2)


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=8), st.booleans())
def test_a_batch_of_one_kind_only_is_no_division_by_zero(errors, human):
    values = torch.tensor(errors, requires_grad=True)
    mask = torch.full((len(errors),), human)
    loss = eq.critic_loss(values, torch.zeros_like(values), mask, torch.ones(len(errors)), True)
    loss.backward()
    assert torch.isfinite(loss)
    assert values.grad is not None
    assert torch.isfinite(values.grad).all()
    assert eq.behaviour_cloning_loss(values[:, None], values[:, None], mask).item() == 0.0
