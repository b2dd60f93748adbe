"""Algorithm 1 written plainly: what the fast learner in ``td3.py`` is tested and timed against.

Every term runs its networks from the picture on, by torch's own operations in single precision;
nothing is shared, nothing is compiled. About three times slower, and easy to read.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import Identity
from torch.nn.functional import conv2d, linear, max_pool2d, relu

from trainer.learner import equations
from trainer.learner.config import OVERRULED_ACTION, Algorithm, LearnerConfig
from trainer.learner.networks import Actor, Critic, CriticPair, Picture
from trainer.learner.replay import Batch
from trainer.learner.td3 import Losses


def picture_features(picture: Picture, frames: Tensor) -> Tensor:
    """Normalised frames (eq. 28) through the two convolutions, [batch, 1792]."""
    hidden = frames[:, -picture.frames :].float() / 255.0
    for layer in (picture.trunk.conv1, picture.trunk.conv2):
        hidden = max_pool2d(relu(conv2d(hidden, layer.weight, layer.bias)), 2)
    return hidden.flatten(1)


def policy_score(actor: Actor, frames: Tensor) -> Tensor:
    """The action before tanh (table A3), [batch, n]."""
    layer = actor.picture.layer
    features = picture_features(actor.picture, frames)
    return actor.head(linear(features, layer.weight, layer.bias))


def policy_action(actor: Actor, frames: Tensor) -> Tensor:
    """pi(s), [batch, n]."""
    return torch.tanh(policy_score(actor, frames))


def value(critic: Critic, frames: Tensor, actions: Tensor) -> Tensor:
    """Q(s, a) (table A2), [batch]: one matrix for the features with the action beside them.

    Unless the features' share is normalised, for which it must be known alone.
    """
    if not isinstance(critic.norm, Identity):
        share = critic.norm(critic.picture.layer(picture_features(critic.picture, frames)))
        return critic.head(share + linear(actions, critic.action.weight))[:, 0]
    joined = torch.cat([picture_features(critic.picture, frames), actions], dim=1)
    weight = torch.cat([critic.picture.layer.weight, critic.action.weight], dim=1)
    return critic.head(linear(joined, weight, critic.picture.layer.bias))[:, 0]


class ReferenceLearner:
    """Actor, two critics, their targets and optimisers; arguments as ``TD3Learner``."""

    def __init__(
        self, config: LearnerConfig, algorithm: Algorithm, seed: int, action_size: int = 1
    ) -> None:
        self.config, self.algorithm = config, algorithm
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = Actor(action_size, config.frames)
            self.critics = CriticPair(
                action_size, config.frames, config.action_bound, config.critic_norm
            )
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), config.actor_learning_rate)
        self.critic_optimiser = torch.optim.Adam(
            self.critics.parameters(), config.critic_learning_rate
        )
        self.noise = torch.Generator().manual_seed(seed)
        self.updates = 0

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """One step of algorithm 1 on a drawn minibatch; ``beta`` is eq. 15's exponent."""
        frames = torch.from_numpy(batch.frames)
        actions, human = torch.from_numpy(batch.actions), torch.from_numpy(batch.human)
        targets = self._targets(batch)
        values = value(self.critics.first, frames, actions)
        critic_loss = self._critic_loss(batch, frames, actions, human, targets, beta)
        errors = self._errors(batch, frames, targets - values)
        policy, cloning = self._actor_losses(frames, actions, human)
        priorities = self._priorities(errors, frames, actions, human)

        self.critic_optimiser.zero_grad()
        critic_loss.backward()
        self.updates += 1
        turn = self.updates % self.config.policy_delay == 0
        if turn:
            loss = policy + self.config.cloning_weight * cloning
            scores = policy_score(self.actor, frames)
            loss = loss + self.config.saturation_weight * scores.square().mean()
            self.actor_optimiser.zero_grad()
            loss.backward(inputs=list(self.actor.parameters()))
            self.actor_optimiser.step()
        self.critic_optimiser.step()
        if turn:
            self._update_targets()
        return Losses(
            critic_loss.item(), policy.item(), cloning.item(), values.mean().item(), priorities
        )

    @torch.no_grad()
    def _targets(self, batch: Batch) -> Tensor:
        c, next_frames = self.config, torch.from_numpy(batch.next_frames)
        next_actions = policy_action(self.target_actor, next_frames)
        noise = c.target_noise * torch.randn(next_actions.shape, generator=self.noise)
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = (
            value(critic, next_frames, next_actions) for critic in self.target_critics.pair
        )
        rewards, terminals = torch.from_numpy(batch.rewards), torch.from_numpy(batch.terminals)
        discount = c.gamma ** torch.as_tensor(batch.spans)
        return equations.td_target(rewards, terminals, (first, second), discount)

    def _critic_loss(
        self,
        batch: Batch,
        frames: Tensor,
        actions: Tensor,
        human: Tensor,
        targets: Tensor,
        beta: float,
    ) -> Tensor:
        probabilities = torch.from_numpy(batch.probabilities).float()
        weights = equations.importance_weights(
            probabilities, beta, self.config.normalise_importance
        )
        first, second = (
            equations.critic_loss(
                value(critic, frames, actions), targets, human, weights, self.config.split_loss
            )
            for critic in self.critics.pair
        )
        if not self._charges_overruled(batch):
            return first + second
        third, fourth = (
            equations.overruled_loss(
                value(critic, frames, torch.from_numpy(batch.overruled)),
                torch.from_numpy(batch.penalised),
                self.config.intervention_penalty,
                weights,
            )
            for critic in self.critics.pair
        )
        return first + second + third + fourth

    @torch.no_grad()
    def _errors(self, batch: Batch, frames: Tensor, errors: Tensor) -> Tensor:
        """What priorities go by: of a penalised action's error and the TD error the larger one."""
        if not self._charges_overruled(batch):
            return errors
        overruled = value(self.critics.first, frames, torch.from_numpy(batch.overruled))
        missed = self.config.intervention_penalty - overruled
        worse = torch.from_numpy(batch.penalised) & (missed.abs() > errors.abs())
        return torch.where(worse, missed, errors)

    def _charges_overruled(self, batch: Batch) -> bool:
        wanted = self.config.penalty_on == OVERRULED_ACTION and self.algorithm.penalty
        return wanted and batch.penalised is not None

    def _actor_losses(
        self, frames: Tensor, actions: Tensor, human: Tensor
    ) -> tuple[Tensor, Tensor]:
        own_actions = policy_action(self.actor, frames)
        cloned = self.algorithm.behaviour_cloning
        policy = equations.policy_loss(
            value(self.critics.first, frames, own_actions),
            human,
            self.config.split_loss and cloned,
        )
        if not cloned:
            return policy, torch.zeros(())
        return policy, equations.behaviour_cloning_loss(own_actions, actions, human)

    @torch.no_grad()
    def _priorities(
        self, td_errors: Tensor, frames: Tensor, actions: Tensor, human: Tensor
    ) -> NDArray[np.float64]:
        row, critic = self.algorithm, self.target_critics.first
        advantage = equations.q_advantage(
            value(critic, frames, actions),
            value(critic, frames, policy_action(self.actor, frames)),
            self.config.advantage_bound,
        )
        priorities = equations.priority(
            td_errors,
            advantage,
            human,
            self.config.priority_offset,
            row.td_weight,
            row.human_td_weight,
            row.advantage_weight,
        )
        return priorities.double().numpy()

    @torch.no_grad()
    def _update_targets(self) -> None:
        for online, target in (
            (self.actor, self.target_actor),
            (self.critics, self.target_critics),
        ):
            for new, old in zip(online.parameters(), target.parameters(), strict=True):
                old.lerp_(new, self.config.tau)
