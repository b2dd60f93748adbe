"""Algorithm 1 written plainly: what the fast learner in ``td3.py`` is tested against.

As there, both losses are taken before either optimiser steps; the paper steps the critics first.

Every term runs its networks from the picture on, by torch's own operations in single precision;
nothing is shared, nothing is compiled. About three times slower, and easy to read.
"""

import copy

import torch
from torch import Tensor
from torch.nn.functional import linear, max_pool2d, relu

from trainer.learner import equations
from trainer.learner.config import OVERRULED_ACTION, Algorithm, LearnerConfig
from trainer.learner.networks import Actor, Critic, CriticPair, Picture
from trainer.learner.replay import Batch
from trainer.learner.td3 import Losses

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
        self.actor_optimiser, self.critic_optimiser = (
            torch.optim.Adam(module.parameters(), rate)
            for module, rate in (
                (self.actor, config.actor_learning_rate),
                (self.critics, config.critic_learning_rate),
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
        if cloned:
            cloning = equations.behaviour_cloning_loss(own_actions, actions, human)
        if row.foresight and batch.foreseen is not None:
            names = ("next_frames", "actions", "overruled")
            ahead, better, worse = (torch.from_numpy(getattr(batch.foreseen, n)) for n in names)
            around = torch.distributions.Normal(
                torch.tanh(policy_score(self.actor, ahead)), 0.5**0.5
            )
            odds = (around.log_prob(better) - around.log_prob(worse)).sum(dim=1)
            policy = policy - torch.log(torch.sigmoid(c.preference_beta * odds)).mean()
        actor_loss = policy + c.cloning_weight * cloning
        actor_loss = actor_loss + c.saturation_weight * scores.square().mean()

        with torch.no_grad():
            judge = self.target_critics.first
            advantage = equations.q_advantage(
                q(judge, frames, actions), q(judge, frames, own_actions), c.advantage_bound
            )
            scheme = row.td_weight, row.human_td_weight, row.advantage_weight
            priorities = equations.priority(errors, advantage, human, c.priority_offset, *scheme)

        self.updates += 1
        self.critic_optimiser.zero_grad()
        critic_loss.backward()
        if self.updates % c.policy_delay == 0:
            self.actor_optimiser.zero_grad()
            actor_loss.backward(inputs=list(self.actor.parameters()))
            self.actor_optimiser.step()
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
