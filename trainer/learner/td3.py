"""The learner: twin delayed DDPG with human guidance (algorithm 1), one update at a time."""

from __future__ import annotations

import copy
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.learner import equations
from trainer.learner.algorithms import Algorithm
from trainer.learner.config import LearnerConfig
from trainer.learner.networks import Actor, CriticPair
from trainer.learner.replay import Batch


class Losses(NamedTuple):
    """What one update reports; ``priorities`` are the batch's new ones (eq. 21)."""

    critic: float
    policy: float
    cloning: float
    mean_value: float
    priorities: NDArray[np.float64]


class TD3Learner:
    """Actor, two critics, their targets and optimisers.

    Both losses are taken at the same weights, before either optimiser steps: the features of a
    picture are then computed once for each network and shared by every term that needs them.

    Args:
        config: hyper-parameters.
        algorithm: the row of the table of switches.
        seed: of the initial weights and of the smoothing noise.
        action_size: length of an action.
        device: where the networks are.
    """

    def __init__(
        self,
        config: LearnerConfig,
        algorithm: Algorithm,
        seed: int,
        action_size: int = 1,
        device: str = "cpu",
    ) -> None:
        self.config, self.algorithm, self.device = config, algorithm, torch.device(device)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = Actor(action_size).to(self.device)
            self.critics = CriticPair(action_size).to(self.device)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = torch.optim.Adam(
            self.actor.parameters(), config.actor_learning_rate, fused=True
        )
        self.critic_optimiser = torch.optim.Adam(
            self.critics.parameters(), config.critic_learning_rate, fused=True
        )
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.updates = 0

    @torch.no_grad()
    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """pi(s) for one observation [2, 45, 80]: float32 [action size]."""
        batch = torch.from_numpy(frames)[None].to(self.device)
        return self.actor(batch)[0].cpu().numpy()

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """One step of algorithm 1 on a drawn minibatch; ``beta`` is eq. 15's exponent."""
        c = self.config
        frames, next_frames = self._tensor(batch.frames), self._tensor(batch.next_frames)
        actions, human = self._tensor(batch.actions), self._tensor(batch.human)
        weights = equations.importance_weights(
            self._tensor(batch.probabilities).float(), beta, c.normalise_importance
        )
        targets = self._targets(batch, next_frames)

        features = [critic.features(frames) for critic in self.critics.pair]
        values = [
            critic.value(feature, actions)
            for critic, feature in zip(self.critics.pair, features, strict=True)
        ]
        first, second = (
            equations.critic_loss(value, targets, human, weights, c.split_loss) for value in values
        )
        critic_loss = first + second
        policy_actions = self.actor(frames)
        policy, cloning = self._actor_losses(features[0].detach(), policy_actions, actions, human)
        priorities = self._priorities(
            targets - values[0].detach(), frames, actions, policy_actions.detach(), human
        )

        self.critic_optimiser.zero_grad()
        critic_loss.backward()
        self.updates += 1
        if self.updates % c.policy_delay == 0:
            self.actor_optimiser.zero_grad()
            loss = policy + c.cloning_weight * cloning
            loss.backward(inputs=list(self.actor.parameters()))
            self.actor_optimiser.step()
        self.critic_optimiser.step()
        if self.updates % c.policy_delay == 0:
            self._update_targets()
        return Losses(
            critic_loss.item(),
            policy.item(),
            cloning.item(),
            values[0].mean().item(),
            priorities.double().cpu().numpy(),
        )

    def decay_learning_rates(self) -> None:
        """Once an episode (table A5)."""
        for optimiser in (self.actor_optimiser, self.critic_optimiser):
            for group in optimiser.param_groups:
                group["lr"] *= self.config.learning_rate_decay

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers, noise and counters: all that a resumed run needs."""
        return {
            "config": asdict(self.config),
            "actor": self.actor.state_dict(),
            "critics": self.critics.state_dict(),
            "target_actor": self.target_actor.state_dict(),
            "target_critics": self.target_critics.state_dict(),
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "noise": self.noise.get_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave."""
        for name in (
            "actor",
            "critics",
            "target_actor",
            "target_critics",
            "actor_optimiser",
            "critic_optimiser",
        ):
            # Optimisers keep the very tensors they are given.
            getattr(self, name).load_state_dict(copy.deepcopy(state[name]))
        self.noise.set_state(state["noise"])
        self.updates = state["updates"]

    @torch.no_grad()
    def _targets(self, batch: Batch, next_frames: Tensor) -> Tensor:
        c = self.config
        next_actions = self.target_actor(next_frames)
        noise = c.target_noise * torch.randn(
            next_actions.shape, generator=self.noise, device=self.device
        )
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = (
            critic.value(critic.features(next_frames), next_actions)
            for critic in self.target_critics.pair
        )
        return equations.td_target(
            self._tensor(batch.rewards), self._tensor(batch.terminals), (first, second), c.gamma
        )

    def _actor_losses(
        self, features: Tensor, policy_actions: Tensor, actions: Tensor, human: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The two terms of eq. 23, unweighted; without cloning the first is over all samples."""
        cloned = self.algorithm.behaviour_cloning
        values = self.critics.first.value(features, policy_actions)
        policy = equations.policy_loss(values, human, self.config.split_loss and cloned)
        if not cloned:
            return policy, torch.zeros((), device=self.device)
        return policy, equations.behaviour_cloning_loss(policy_actions, actions, human)

    @torch.no_grad()
    def _priorities(
        self,
        td_errors: Tensor,
        frames: Tensor,
        actions: Tensor,
        policy_actions: Tensor,
        human: Tensor,
    ) -> Tensor:
        """Eq. 21; the target critic looks only at the human's samples, the only ones that count."""
        c, row = self.config, self.algorithm
        advantage = torch.zeros_like(td_errors)
        if row.advantage_weight and bool(human.any()):
            critic = self.target_critics.first
            features = critic.features(frames[human])
            advantage[human] = equations.q_advantage(
                critic.value(features, actions[human]),
                critic.value(features, policy_actions[human]),
                c.advantage_bound,
            )
        return equations.priority(
            td_errors,
            advantage,
            human,
            c.priority_offset,
            row.td_weight,
            row.human_td_weight,
            row.advantage_weight,
        )

    @torch.no_grad()
    def _update_targets(self) -> None:
        for online, target in (
            (self.actor, self.target_actor),
            (self.critics, self.target_critics),
        ):
            torch._foreach_lerp_(
                list(target.parameters()), list(online.parameters()), self.config.tau
            )

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self.device)
