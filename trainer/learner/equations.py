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
    """Return the human's action where the human acts, else the policy's (eq. 9 and 18a)."""
    return policy_action if human_action is None else human_action


def correlated(
    before: NDArray[np.float64], correlation: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Draw the next numbers of a first-order autoregressive process, shaped as ``before``.

    ``correlation`` is that of successive numbers; 0 draws each anew. Started from zeros, the k-th
    numbers have the standard deviation sqrt(1 - correlation^(2 k)), which tends to 1.
    """
    fresh = random.standard_normal(before.shape)
    return correlation * before + math.sqrt(1.0 - correlation**2) * fresh


def exploration_noise(scale: float, bound: float, drawn: NDArray[np.float64]) -> Action:
    """Scale standard normal numbers by ``scale`` and clip them to +-``bound`` (eq. 18b)."""
    return np.clip(scale * drawn, -bound, bound).astype(np.float32)


def shaped_reward(reward: float, penalty: float, human: bool, human_before: bool) -> float:
    """Add ``penalty`` (negative) to the first step of an intervention, and to no other (eq. 17)."""
    return reward + penalty if human and not human_before else reward


def smoothed_target_action(action: Tensor, noise: Tensor, bound: float) -> Tensor:
    """Add noise clipped to +-``bound``, and clip to [-1, 1]: TD3's target policy smoothing."""
    return (action + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)


def td_target(
    rewards: Tensor,
    terminals: Tensor,
    next_values: tuple[Tensor, Tensor],
    gamma: float | Tensor,
) -> Tensor:
    """Return the target of eq. 22: r + gamma min(Q'_1, Q'_2), and r alone at a terminal state.

    For an m-step return ``rewards`` are discounted sums of m rewards, and ``gamma`` is gamma^m.
    """
    return rewards + gamma * (1.0 - terminals) * torch.minimum(*next_values)


def q_advantage(human_value: Tensor, policy_value: Tensor, exponent_bound: float) -> Tensor:
    """Return the Q advantage of eq. 21b: exp[Q'(s, a) - Q'(s, pi(s))].

    The exponent is held within +-``exponent_bound``: an early critic can be so far off that the
    exponential overflows, and one infinite priority would end all sampling.
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
    """Return |delta| + epsilon, plus the Q advantage where the human acted (eq. 13 and 21a).

    Section VII-E's other schemes: TD alone with human weights doubled (``human_td_weight=2,
    advantage_weight=0``), Q advantage alone (``human_td_weight=0``).
    """
    weight = torch.where(human, human_td_weight, td_weight)
    return weight * td_error.abs() + offset + advantage_weight * advantage * human


def importance_weights(probabilities: Tensor, beta: float, normalise: bool) -> Tensor:
    """Return p(i) ** -beta (eq. 15).

    ``normalise`` divides by the batch's largest weight, as the original prioritised replay does;
    without it the weights grow with the buffer and scale the learning rate.
    """
    weights = probabilities.pow(-beta)
    return weights / weights.max() if normalise else weights


def critic_loss(
    values: Tensor, targets: Tensor, human: Tensor, weights: Tensor, split: bool
) -> Tensor:
    """Return the mean squared TD error (eq. 22) with the importance weights of eq. 16.

    ``split`` is the paper's form: the mean over the policy's samples plus the mean over the human's
    (eq. 11 and 12). Otherwise one mean over all.
    """
    losses = weights * (targets - values).square()
    return _masked_mean(losses, ~human) + _masked_mean(losses, human) if split else losses.mean()


def overruled_loss(values: Tensor, penalised: Tensor, penalty: float, weights: Tensor) -> Tensor:
    """Draw the values [n] of overruled actions towards the penalty, in ``penalised`` rows only.

    Not in the paper, which lowers the reward of the human's own first action (eq. 17). The mean is
    over the whole batch.
    """
    return (weights * penalised * (penalty - values).square()).mean()


def proxy_value_loss(human_values: Tensor, overruled_values: Tensor, human: Tensor) -> Tensor:
    """Return the mean of (Q(s, a_human) - 1)^2 + (Q(s, a_overruled) + 1)^2 over the batch [n].

    Proxy value propagation (2502.03369): only ``human`` rows contribute; TD without a reward
    propagates these values to the others.
    """
    losses = (human_values - 1.0).square() + (overruled_values + 1.0).square()
    return (human * losses).mean()


def policy_loss(values: Tensor, human: Tensor, split: bool) -> Tensor:
    """Return -Q_1(s, pi(s)), the first term of eq. 23; of the policy's samples where ``split``."""
    return _masked_mean(-values, ~human) if split else -values.mean()


def behaviour_cloning_loss(
    actions: Tensor,
    human_actions: Tensor,
    human: Tensor,
    weights: Tensor | None = None,
    bound: float = 0.0,
) -> Tensor:
    """Return the mean squared distance to the human's actions: eq. 23's second term, unweighted.

    ``weights`` [n] are about 1 on average. Beyond ``bound``, unless that is 0, the loss grows
    linearly with the distance (pseudo-Huber): the actor then learns what most of the human's
    actions in a state are, not their mean.
    """
    distances = (human_actions - actions).square().sum(dim=1)
    if bound:
        distances = 2.0 * bound**2 * ((1.0 + distances / bound**2).sqrt() - 1.0)
    return _masked_mean(distances if weights is None else weights * distances, human)


def cloning_weights(human_value: Tensor, policy_value: Tensor) -> Tensor:
    """Return 2 sigmoid(Q'(s, a) - Q'(s, pi(s))): a human action that the critic doubts counts less.

    Not in the paper.
    """
    return 2.0 * torch.sigmoid(human_value - policy_value)


def preference_loss(actions: Tensor, preferred: Tensor, overruled: Tensor, beta: float) -> Tensor:
    """Return the mean of -log sigmoid(beta log pi(a+) - beta log pi(a-)) (2510.01545).

    A deterministic policy counts as a normal distribution around its ``actions``, so the logarithms
    differ as the squared distances do.
    """
    margin = (overruled - actions).square().sum(dim=1) - (preferred - actions).square().sum(dim=1)
    return softplus(-beta * margin).mean()


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over the masked samples; 0 where there is none."""
    # No branch on the count: a GPU would have to wait for it.
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)
