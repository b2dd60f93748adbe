"""Algorithm 1 written plainly, and the fast learner in ``td3.py`` against it: same weights, same
batches, same result.

As there, both losses are taken before either optimiser steps; the paper steps the critics first.

Every term runs its networks from the picture on, by torch's own operations in single precision;
nothing is shared, nothing is compiled. About three times slower, and easy to read.
"""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import linear, max_pool2d, relu

from trainer.learner import equations
from trainer.learner.config import ALGORITHMS, OVERRULED_ACTION, PHIL, Algorithm, LearnerConfig
from trainer.learner.networks import Actor, Critic, CriticPair, Picture
from trainer.learner.replay import Batch
from trainer.learner.td3 import Losses, TD3Learner
from trainer.tests.learners import SMALL, make_batch, same_weights, weights_of

COLUMNS = (
    "frames", "actions", "rewards", "next_frames", "terminals", "human", "overruled", "penalised"
)  # fmt: skip


def embedded(picture: Picture, frames: Tensor) -> Tensor:
    """Normalised frames (eq. 28) through two convolutions and one layer, [batch, 256]."""
    hidden = frames[:, -picture.frames :].float() / 255.0
    for layer in (picture.trunk.conv1, picture.trunk.conv2):
        hidden = max_pool2d(relu(layer(hidden)), 2)
    return picture.layer(hidden.flatten(1))


def policy_score(actor: Actor, frames: Tensor) -> Tensor:
    """The action before tanh (table A3), [batch, n]."""
    return actor.head(embedded(actor.picture, frames))


def q(critic: Critic, frames: Tensor, actions: Tensor) -> Tensor:
    """Q(s, a) (table A2), [batch]."""
    share = critic.norm(embedded(critic.picture, frames))
    return critic.head(share + linear(actions, critic.action.weight))[:, 0]


class ReferenceLearner:
    """Actor, two critics, their targets and optimisers; arguments as ``TD3Learner``'s."""

    def __init__(self, config: LearnerConfig, algorithm: Algorithm, seed: int) -> None:
        self.config, self.algorithm = config, algorithm
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = Actor(1, config.frames)
            self.critics = CriticPair(1, config.frames, config.action_bound, config.critic_norm)
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_optimiser, self.critic_optimiser, self.cloning_optimiser = (
            torch.optim.Adam(module.parameters(), rate)
            for module, rate in (
                (self.actor, config.actor_learning_rate),
                (self.critics, config.critic_learning_rate),
                (self.actor, config.cloning_learning_rate),
            )
        )
        self.noise = torch.Generator().manual_seed(seed)
        self.updates = 0

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """One step of algorithm 1 on a drawn minibatch; ``beta`` is eq. 15's exponent."""
        c, row, first = self.config, self.algorithm, self.critics.first
        frames, actions, rewards, next_frames, terminals, human, overruled, penalised = (
            torch.from_numpy(getattr(batch, name)) for name in COLUMNS
        )
        with torch.no_grad():
            next_actions = torch.tanh(policy_score(self.target_actor, next_frames))
            noise = c.target_noise * torch.randn(next_actions.shape, generator=self.noise)
            next_actions = equations.smoothed_target_action(
                next_actions, noise, c.target_noise_bound
            )
            one, other = (q(each, next_frames, next_actions) for each in self.target_critics.pair)
            discount = c.gamma ** torch.as_tensor(batch.spans)
            targets = equations.td_target(rewards, terminals, (one, other), discount)

        probabilities = torch.from_numpy(batch.probabilities).float()
        weights = equations.importance_weights(probabilities, beta, c.normalise_importance)
        critic_loss = torch.zeros(())
        for critic in self.critics.pair:
            values = q(critic, frames, actions)
            critic_loss += equations.critic_loss(values, targets, human, weights, c.split_loss)
        values = q(first, frames, actions).detach()
        errors = targets - values
        if row.penalty and c.penalty_on == OVERRULED_ACTION:
            for critic in self.critics.pair:
                critic_loss += equations.overruled_loss(
                    q(critic, frames, overruled), penalised, c.intervention_penalty, weights
                )
            missed = c.intervention_penalty - q(first, frames, overruled).detach()
            errors = torch.where(penalised & (missed.abs() > errors.abs()), missed, errors)
        if row.proxy_values:
            for critic in self.critics.pair:
                theirs, ours = q(critic, frames, actions), q(critic, frames, overruled)
                critic_loss += (human * ((theirs - 1.0) ** 2 + (ours + 1.0) ** 2)).mean()

        scores = policy_score(self.actor, frames)
        own_actions, cloned, cloning = torch.tanh(scores), row.behaviour_cloning, torch.zeros(())
        own_values = q(first, frames, own_actions)
        policy = equations.policy_loss(own_values, human, c.split_loss and cloned) * row.q_term
        with torch.no_grad():
            judge = self.target_critics.first
            judged = q(judge, frames, actions), q(judge, frames, own_actions)
        if cloned:
            names = ("frames", "actions", "human")
            seen, shown, by_human = (
                torch.from_numpy(getattr(batch.shown or batch, n)) for n in names
            )
            imitating = torch.tanh(policy_score(self.actor, seen))
            with torch.no_grad():
                preferred = q(judge, seen, shown) - q(judge, seen, imitating)
            weights = 2.0 / (1.0 + torch.exp(-preferred))
            cloning = equations.behaviour_cloning_loss(
                imitating,
                shown,
                by_human,
                weights if row.weighted_cloning else None,
                c.cloning_bound,
            )
        if row.foresight and batch.foreseen is not None:
            names = ("next_frames", "actions", "overruled")
            ahead, better, worse = (torch.from_numpy(getattr(batch.foreseen, n)) for n in names)
            around = torch.distributions.Normal(
                torch.tanh(policy_score(self.actor, ahead)), 0.5**0.5
            )
            odds = (around.log_prob(better) - around.log_prob(worse)).sum(dim=1)
            policy = policy - torch.log(torch.sigmoid(c.preference_beta * odds)).mean()
        policy_loss = policy + c.saturation_weight * scores.square().mean()

        with torch.no_grad():
            advantage = equations.q_advantage(*judged, c.advantage_bound)
            scheme = row.td_weight, row.human_td_weight, row.advantage_weight
            priorities = equations.priority(errors, advantage, human, c.priority_offset, *scheme)

        self.updates += 1
        self.critic_optimiser.zero_grad()
        critic_loss.backward()
        if self.updates % c.policy_delay == 0:
            parameters = list(self.actor.parameters())
            if batch.shown:  # An optimiser for each of the two terms
                steps = [(self.actor_optimiser, policy_loss)] if row.q_term else []
                steps.append((self.cloning_optimiser, cloning))
            else:
                steps = [(self.actor_optimiser, policy_loss + c.cloning_weight * cloning)]
            gradients = [torch.autograd.grad(loss, parameters) for _, loss in steps]
            for (optimiser, _), towards in zip(steps, gradients, strict=True):
                for parameter, gradient in zip(parameters, towards, strict=True):
                    parameter.grad = gradient
                optimiser.step()
        self.critic_optimiser.step()
        if self.updates % c.policy_delay == 0:
            for online, target in (
                (self.actor, self.target_actor),
                (self.critics, self.target_critics),
            ):
                for new, old in zip(online.parameters(), target.parameters(), strict=True):
                    old.data.lerp_(new.data, c.tau)
        loss, mean_value = critic_loss.item(), values.mean().item()
        drawn_by = priorities.double().numpy()
        return Losses(loss, policy.item(), cloning.item(), mean_value, drawn_by)


def both(config: LearnerConfig, algorithm: Algorithm) -> tuple[TD3Learner, ReferenceLearner]:
    """With targets that differ from the online networks, as they do after some updates."""
    fast, plain = TD3Learner(config, algorithm, 2), ReferenceLearner(config, algorithm, 2)
    for learner in (fast, plain):
        random = torch.Generator().manual_seed(5)
        with torch.no_grad():
            for module in (learner.target_actor, learner.target_critics):
                for p in module.parameters():
                    p.add_(0.02 * torch.randn(p.shape, generator=random))
            # Fresh critics hardly feel the action: without this, whose it was would not show.
            learner.target_actor.head.output.bias.add_(0.5)
            for critic in learner.target_critics.pair:
                critic.action.weight += 0.5
    return fast, plain


def check(
    config: LearnerConfig, algorithm: Algorithm, humans: int = 4, shown: Batch | None = None
) -> None:
    fast, plain = both(config, algorithm)
    start = weights_of(fast)
    for seed in range(2):
        batch, off = replace(make_batch(seed, humans), shown=shown), 1e-3 if seed else 1e-5
        ours, wanted = fast.update(batch, beta=0.5), plain.update(batch, beta=0.5)
        np.testing.assert_allclose(ours[:4], wanted[:4], rtol=off, atol=0.01 * off)
        np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=max(off, 1e-4))
        modules = (fast.actor, plain.actor), (fast.critics, plain.critics)
        for pair in () if seed else modules:
            for p, right_p in zip(*(module.parameters() for module in pair), strict=True):
                if right_p.grad is not None:  # a delayed policy's turn is still to come
                    assert p.grad is not None
                    assert (p.grad - right_p.grad).norm() <= 1e-3 * right_p.grad.norm()
    for name, flat in weights_of(fast).items():
        # Adam amplifies rounding where a gradient is nearly nothing: compare the step as a whole.
        right = weights_of(plain)[name]
        step = (right - start[name]).norm()
        assert (flat - right).norm() <= 0.02 * step, name


# To the learner the others are one of these: they differ in what is stored, and how it is drawn.
ALIKE = {"rd2_td3", "rd2_phil", "rlpd_td3", "phil_gated"}


@pytest.mark.parametrize("name", sorted(ALGORITHMS.keys() - ALIKE))
def test_every_algorithm(name):
    check(replace(SMALL, **ALGORITHMS[name].settings), ALGORITHMS[name])


@pytest.mark.parametrize(
    "change",
    [
        {"split_loss": True},
        {"policy_delay": 2},
        {"normalise_importance": False},
        {"frames": 1},
        {"saturation_weight": 0.3},
        {"gamma": 0.5, "tau": 0.1},
        {"target_noise": 0.5},
        {"penalty_on": "human"},
        {"critic_norm": False},
    ],
    ids=lambda change: "-".join(change),
)
def test_every_switch(change):
    check(replace(SMALL, **change), PHIL)


@pytest.mark.parametrize("humans", [0, 12])
def test_batches_of_one_kind(humans):
    check(replace(SMALL, split_loss=True), PHIL, humans)


@pytest.mark.parametrize("name", ["phil_td3", "phil_weighted", "cloning_only"])
def test_a_batch_of_its_own_is_imitated_by_an_optimiser_of_its_own(name):
    check(SMALL, ALGORITHMS[name], shown=make_batch(9, humans=7, size=7))


def test_reduced_precision_is_near_and_repeatable():
    """bfloat16 keeps 8 bits of each factor: the gradients stay within a few percent."""
    fast, plain = both(replace(SMALL, precision="bfloat16"), PHIL)
    again, _ = both(replace(SMALL, precision="bfloat16"), PHIL)
    batch = make_batch(0)
    ours, wanted = fast.update(batch), plain.update(batch)
    again.update(batch)
    np.testing.assert_allclose(ours.critic_loss, wanted.critic_loss, rtol=0.02)
    np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=0.1, atol=0.02)
    for got, right in zip(fast.actor.parameters(), plain.actor.parameters(), strict=True):
        assert got.grad is not None
        assert right.grad is not None
        assert torch.cosine_similarity(got.grad.flatten(), right.grad.flatten(), dim=0) > 0.99
    assert same_weights(fast, again)


def test_the_doubt_is_how_far_the_critics_are_apart():
    fast, plain = both(SMALL, ALGORITHMS["phil_gated"])
    batch = make_batch(0)
    seen, actions = torch.from_numpy(batch.frames[:1].copy()), torch.from_numpy(batch.actions[:1])
    one, other = (q(critic, seen, actions).item() for critic in plain.critics.pair)
    assert fast.doubt(batch.frames[0], batch.actions[0]) == pytest.approx(
        abs(one - other), rel=1e-3
    )
