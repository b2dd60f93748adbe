"""The paper's equations against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch

from trainer.learner import equations as eq


def t(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


HUMAN = torch.tensor([False, True, False, True])
PENALISED = torch.tensor([True, False, True, False])
ERRORS, ADVANTAGES = t(2.0, 2.0, 1.0, 1.0), t(0.0, 3.0, 0.0, 3.0)
HALVES, ONES = t(0.5, 0.25), t(1.0, 1.0, 1.0, 1.0)
TARGETS, VALUES = t(1.0, 3.0, 2.0, 1.0), t(1.0, 10.0, 3.0, 20.0)


@pytest.mark.parametrize(
    ("equation", "given", "wanted"),
    [
        # Eq. 17: only the first step of an intervention is penalised.
        (eq.shaped_reward, (0.5, -10.0, True, False), -9.5),
        (eq.shaped_reward, (0.5, -10.0, True, True), 0.5),
        (eq.shaped_reward, (0.5, -10.0, False, True), 0.5),
        (eq.shaped_reward, (0.5, -10.0, False, False), 0.5),
        # ... or on the overruled action.
        (eq.overruled_loss, (t(-9, 5, -10, 5), PENALISED, -10.0, t(2, 1, 1, 1)), 2.0 * 1.0 / 4),
        # Proxy values: 1 for the human's action, -1 for the overruled one, where a human acted.
        (eq.proxy_value_loss, (t(9, 2, 9, 1), t(9, 1, 9, -1), HUMAN), (1.0 + 4.0 + 0.0 + 0.0) / 4),
        # Preference: 0.75 nearer to the better action, and as near to both.
        (eq.preference_loss, (t(0.5, 0)[:, None], t(1, 1)[:, None], t(-0.5, -1)[:, None], 2.0),
         (math.log1p(math.exp(-2.0 * 0.75)) + math.log(2.0)) / 2),
        (eq.smoothed_target_action, (t(0, 0, 0.9, -0.9), t(2, -2, 0.3, -0.3), 0.5),
         [0.5, -0.5, 1.0, -1.0]),
        # Eq. 22: the smaller value, and none at terminals; several steps have a power of gamma.
        (eq.td_target, (t(1, 1), t(0, 1), (t(2, 5), t(4, 3)), 0.5), [1.0 + 0.5 * 2.0, 1.0]),
        (eq.td_target, (t(1, 1), t(0, 0), (t(4, 4), t(9, 9)), t(0.5, 0.25)), [3.0, 2.0]),
        # Eq. 21b, which cannot overflow.
        (eq.q_advantage, (t(1, 0), t(0, 2), 4.0), [math.e, math.exp(-2.0)]),
        (eq.q_advantage, (t(1e6), t(-1e6), 4.0), [math.exp(4.0)]),
        # Eq. 21a; other schemes are weights.
        (eq.priority, (t(2, -2, 0, 0.5), t(9, 3, 9, 1), HUMAN, 0.001),
         [2.001, 5.001, 0.001, 1.501]),
        (eq.priority, (ERRORS, ADVANTAGES, HUMAN, 0.0, 1.0, 2.0, 0.0), [2.0, 4.0, 1.0, 2.0]),
        (eq.priority, (ERRORS, ADVANTAGES, HUMAN, 0.0, 1.0, 0.0, 1.0), [2.0, 3.0, 1.0, 3.0]),
        # Eq. 15.
        (eq.importance_weights, (HALVES, 1.0, False), [2.0, 4.0]),
        (eq.importance_weights, (HALVES, 1.0, True), [0.5, 1.0]),
        (eq.importance_weights, (HALVES, 0.0, True), [1.0, 1.0]),
        # Eq. 22, split: policy (1 + 4) / 2, human (9 + 1) / 2. Eq. 16 weighs each squared error.
        (eq.critic_loss, (0.0 * ONES, TARGETS, HUMAN, ONES, True), 2.5 + 5.0),
        (eq.critic_loss, (0.0 * ONES, TARGETS, HUMAN, ONES, False), 15.0 / 4),
        (eq.critic_loss, (t(0, 0), t(1, 2), HUMAN[:2], t(1, 0.5), False), (1.0 + 2.0) / 2),
        # Eq. 23: the policy's term, and cloning's.
        (eq.policy_loss, (VALUES, HUMAN, True), -2.0),
        (eq.policy_loss, (VALUES, HUMAN, False), -8.5),
        (eq.behaviour_cloning_loss, (t(0, 0.5, 0, -1)[:, None], t(9, 1, 9, 1)[:, None], HUMAN),
         (0.25 + 4.0) / 2),
        (eq.behaviour_cloning_loss,
         (t(0, 0.5, 0, -1)[:, None], t(9, 1, 9, 1)[:, None], HUMAN, t(0, 2, 0, 1)),
         (2 * 0.25 + 4.0) / 2),
        # Near the square below the bound of 0.5, near 2 * 0.5 times the distance above it.
        (eq.behaviour_cloning_loss,
         (t(0, 0.5, 0, -1)[:, None], t(9, 1, 9, 1)[:, None], HUMAN, None, 0.5),
         0.5 * (math.sqrt(2.0) + math.sqrt(17.0) - 2.0) / 2),
        # What the critic finds as good counts as before; at odds of 3 to 1, half more.
        (eq.cloning_weights, (t(1, math.log(3.0)), t(1, 0)), [1.0, 1.5]),
    ],
)  # fmt: skip
def test_by_hand(equation, given, wanted):
    found = torch.as_tensor(equation(*given), dtype=torch.float64).tolist()
    assert found == pytest.approx(wanted, rel=1e-12)


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
