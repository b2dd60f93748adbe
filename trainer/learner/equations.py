"""The paper's equations, one short function each.

Batches come as torch tensors: ``human`` is the mask Delta as bool [n], values and errors are [n],
actions [n, action size].
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import softplus

from trainer.learner.replay import Action


def masked_action(policy_action: Action, human_action: Action | None) -> Action:
    """Eq. 9 and 18a: the human's action where the human acts, else the policy's."""
    return policy_action if human_action is None else human_action


def correlated(
    before: NDArray[np.float64], correlation: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """The next numbers of a first-order autoregressive process, as ``before``.

    ``correlation`` is that of two in a row; 0 draws each anew. They tend to standard normal ones:
    from zeros, the k-th numbers have the deviation sqrt(1 - correlation^(2 k)).
    """
    fresh = random.standard_normal(before.shape)
    return correlation * before + math.sqrt(1.0 - correlation**2) * fresh


def exploration_noise(scale: float, bound: float, drawn: NDArray[np.float64]) -> Action:
    """Eq. 18b: standard normal numbers times ``scale``, clipped to +-``bound``."""
    return np.clip(scale * drawn, -bound, bound).astype(np.float32)


def shaped_reward(reward: float, penalty: float, human: bool, human_before: bool) -> float:
    """Eq. 17: the first step of an intervention, and no other, costs ``penalty`` (negative)."""
    return reward + penalty if human and not human_before else reward


def smoothed_target_action(action: Tensor, noise: Tensor, bound: float) -> Tensor:
    """TD3's target policy smoothing: adds noise clipped to +-``bound``, and clips to [-1, 1]."""
    return (action + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)


def td_target(
    rewards: Tensor,
    terminals: Tensor,
    next_values: tuple[Tensor, Tensor],
    gamma: float | Tensor,
) -> Tensor:
    """The target of eq. 22: r + gamma min(Q'_1, Q'_2), and r alone at a terminal state.

    Over m steps ``rewards`` is the discounted sum of m of them, and ``gamma`` its own m-th power.
    """
    return rewards + gamma * (1.0 - terminals) * torch.minimum(*next_values)


def q_advantage(human_value: Tensor, policy_value: Tensor, exponent_bound: float) -> Tensor:
    """Eq. 21b: exp[Q'(s, a) - Q'(s, pi(s))].

    The exponent is held within +-``exponent_bound``: a critic early in training can be off by
    more than float can take the exponential of, and one infinity would end all sampling.
    """
    return torch.exp((human_value - policy_value).clamp(-exponent_bound, exponent_bound))


def priority(
    td_error: Tensor,
    advantage: Tensor,
    human: Tensor,
    offset: float,
    td_weight: float = 1.0,
    human_td_weight: float = 1.0,
    advantage_weight: float = 1.0,
) -> Tensor:
    """Eq. 13 and 21a: |delta| + epsilon, and the Q advantage where the human acted.

    The weights make section VII-E's other schemes: TD alone with human weights doubled
    (``human_td_weight=2, advantage_weight=0``), Q advantage alone (``human_td_weight=0``).
    """
    weight = torch.where(human, human_td_weight, td_weight)
    return weight * td_error.abs() + offset + advantage_weight * advantage * human


def importance_weights(probabilities: Tensor, beta: float, normalise: bool) -> Tensor:
    """Eq. 15: p(i) ** -beta.

    ``normalise`` divides by the batch's largest weight, as the paper's source of prioritised
    replay does; without it the weights grow with the buffer and scale the learning rate.
    """
    weights = probabilities.pow(-beta)
    return weights / weights.max() if normalise else weights


def critic_loss(
    values: Tensor, targets: Tensor, human: Tensor, weights: Tensor, split: bool
) -> Tensor:
    """Eq. 22, with the importance weights of eq. 16: squared TD errors.

    ``split`` is the paper's form, the mean over the policy's samples plus the mean over the human's
    (eq. 11 and 12); otherwise one mean over all.
    """
    losses = weights * (targets - values).square()
    return _masked_mean(losses, ~human) + _masked_mean(losses, human) if split else losses.mean()


def overruled_loss(values: Tensor, penalised: Tensor, penalty: float, weights: Tensor) -> Tensor:
    """Eq. 17 where it hits the action that the human overruled: its value is the penalty.

    Not in the paper, which lowers the reward of the human's own first action. ``values`` [n] are
    those of the overruled actions; only ``penalised`` rows count, in one mean over the batch.
    """
    return (weights * penalised * (penalty - values).square()).mean()


def proxy_value_loss(human_values: Tensor, overruled_values: Tensor, human: Tensor) -> Tensor:
    """Proxy value propagation (2502.03369): (Q(s, a_human) - 1)^2 + (Q(s, a_overruled) + 1)^2.

    In one mean over the batch [n], to which only the ``human`` rows add. TD without a reward
    carries these values on to the others.
    """
    losses = (human_values - 1.0).square() + (overruled_values + 1.0).square()
    return (human * losses).mean()


def policy_loss(values: Tensor, human: Tensor, split: bool) -> Tensor:
    """First term of eq. 23: -Q_1(s, pi(s)), over the policy's samples only where ``split``."""
    return _masked_mean(-values, ~human) if split else -values.mean()


def behaviour_cloning_loss(actions: Tensor, human_actions: Tensor, human: Tensor) -> Tensor:
    """Second term of eq. 23 without its weight: mean squared distance to the human's actions."""
    return _masked_mean((human_actions - actions).square().sum(dim=1), human)


def preference_loss(actions: Tensor, preferred: Tensor, overruled: Tensor, beta: float) -> Tensor:
    """Contrastive preference (2510.01545): -log sigmoid(beta log pi(a+) - beta log pi(a-)), a mean.

    A policy without noise counts as a normal distribution around its ``actions``, so that the two
    logarithms differ as the squared distances do.
    """
    nearer = (overruled - actions).square().sum(dim=1) - (preferred - actions).square().sum(dim=1)
    return softplus(-beta * nearer).mean()


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean over some samples; 0 where there is none."""
    # No branch on the count: on a GPU it would wait for the answer.
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)
