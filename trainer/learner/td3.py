"""The learner: twin delayed DDPG with human guidance (algorithm 1), one update at a time.

``reference.py`` is the same written plainly; this one computes nothing twice and, on an
accelerator, never waits for a number.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.learner import equations
from trainer.learner.algorithms import Algorithm
from trainer.learner.config import LearnerConfig
from trainer.learner.minibatch import Losses, Minibatch, Outcome
from trainer.learner.networks import Actor, CriticPair
from trainer.learner.optimiser import load_adam, make_adam
from trainer.learner.precision import multiplies_bfloat16
from trainer.learner.replay import Batch


class TD3Learner:
    """Actor, two critics, their targets and optimisers.

    Both losses are taken at the same weights, before either optimiser steps: a picture is then
    embedded once for each network and shared by every term that needs it.

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
            self.actor = Actor(action_size, config.frames).to(self.device)
            self.critics = CriticPair(action_size, config.frames).to(self.device)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = make_adam(self.actor, config.actor_learning_rate, self.device)
        self.critic_optimiser = make_adam(self.critics, config.critic_learning_rate, self.device)
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.updates = 0

    @torch.no_grad()
    def act(self, frames: NDArray[np.uint8], averaged: bool = False) -> NDArray[np.float32]:
        """pi(s) for one observation [2, 45, 80], or the target actor's: float32 [action size]."""
        batch = torch.from_numpy(frames)[None].to(self.device)
        actor = self.target_actor if averaged else self.actor
        return actor(batch)[0].cpu().numpy()

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """One step of algorithm 1 on a drawn minibatch; ``beta`` is eq. 15's exponent."""
        columns = (getattr(batch, name) for name in Minibatch._fields)
        minibatch = Minibatch(*(torch.from_numpy(column).to(self.device) for column in columns))
        outcome = self.step(minibatch, torch.tensor(beta, device=self.device))
        critic, policy, cloning, value = outcome.losses.tolist()
        priorities = outcome.priorities.double().cpu().numpy()
        return Losses(critic, policy, cloning, value, priorities)

    def step(self, batch: Minibatch, beta: Tensor) -> Outcome:
        """The same for a batch that is on the device already, and nothing read back."""
        return self.change(batch, beta, with_policy=self.count_update())

    def count_update(self) -> bool:
        """Count an update that begins; whether it is the policy's turn, too (table A5: d)."""
        self.updates += 1
        return self.updates % self.config.policy_delay == 0

    def change(self, batch: Minibatch, beta: Tensor, with_policy: bool) -> Outcome:
        """One step on all weights, or on the critics' alone: what a CUDA graph captures."""
        c, human, actions = self.config, batch.human, batch.actions
        targets = self._targets(batch)
        with self._precision():
            pictures = [critic.embed(batch.frames) for critic in self.critics.pair]
            own_picture = self.actor.embed(batch.frames)
        values = [
            critic.value(picture, actions)
            for critic, picture in zip(self.critics.pair, pictures, strict=True)
        ]
        weights = equations.importance_weights(
            batch.probabilities.float(), beta, c.normalise_importance
        )
        first, second = (
            equations.critic_loss(value, targets, human, weights, c.split_loss) for value in values
        )
        critic_loss = first + second
        score = self.actor.score(own_picture)
        own_actions = torch.tanh(score)
        policy, cloning = self._actor_losses(pictures[0].detach(), own_actions, actions, human)
        priorities = self._priorities(targets - values[0].detach(), batch, own_actions.detach())

        _differentiate(critic_loss, self.critics)
        if with_policy:
            loss = policy + c.cloning_weight * cloning
            if c.saturation_weight:
                loss = loss + c.saturation_weight * score.square().mean()
            _differentiate(loss, self.actor)
            self.actor_optimiser.step()
        self.critic_optimiser.step()
        if with_policy:
            self._update_targets()
        found = (critic_loss, policy, cloning, values[0].mean())
        return Outcome(torch.stack([loss.detach() for loss in found]), priorities)

    def decay_learning_rates(self) -> None:
        """Once an episode (table A5)."""
        for optimiser in (self.actor_optimiser, self.critic_optimiser):
            for group in optimiser.param_groups:
                group["lr"] *= self.config.learning_rate_decay

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers, noise and counters: all that a resumed run needs."""
        return {
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
        for name in ("actor", "critics", "target_actor", "target_critics"):
            getattr(self, name).load_state_dict(state[name])
        load_adam(self.actor_optimiser, state["actor_optimiser"])
        load_adam(self.critic_optimiser, state["critic_optimiser"])
        self.noise.set_state(state["noise"])
        self.updates = state["updates"]

    def _precision(self) -> torch.autocast:
        kind = self.device.type
        reduced = self.config.precision == "bfloat16" and multiplies_bfloat16(kind)
        return torch.autocast(kind, torch.bfloat16, enabled=reduced)

    @torch.no_grad()
    def _targets(self, batch: Minibatch) -> Tensor:
        c = self.config
        with self._precision():
            own_picture = self.target_actor.embed(batch.next_frames)
            pictures = [critic.embed(batch.next_frames) for critic in self.target_critics.pair]
        next_actions = torch.tanh(self.target_actor.score(own_picture))
        noise = c.target_noise * torch.randn(
            next_actions.shape, generator=self.noise, device=self.device
        )
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = (
            critic.value(picture, next_actions)
            for critic, picture in zip(self.target_critics.pair, pictures, strict=True)
        )
        return equations.td_target(batch.rewards, batch.terminals, (first, second), c.gamma)

    def _actor_losses(
        self, picture: Tensor, own_actions: Tensor, actions: Tensor, human: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The two terms of eq. 23, unweighted; without cloning the first is over all samples."""
        cloned = self.algorithm.behaviour_cloning
        values = self.critics.first.value(picture, own_actions)
        policy = equations.policy_loss(values, human, self.config.split_loss and cloned)
        if not cloned:
            return policy, torch.zeros((), device=self.device)
        return policy, equations.behaviour_cloning_loss(own_actions, actions, human)

    @torch.no_grad()
    def _priorities(self, td_errors: Tensor, batch: Minibatch, own_actions: Tensor) -> Tensor:
        """Eq. 21; the target critic looks only at the human's samples, the only ones that count."""
        c, row, human = self.config, self.algorithm, batch.human
        advantage = torch.zeros_like(td_errors)
        # To pick samples is to wait for their number, which an accelerator must not.
        looked_at = human.nonzero()[:, 0] if self.device.type == "cpu" else slice(None)
        if row.advantage_weight and td_errors[looked_at].numel():
            critic, frames = self.target_critics.first, batch.frames
            if isinstance(looked_at, Tensor):
                # Copies picture by picture; [looked_at] would go byte by byte, 25 times as slow.
                frames = frames.index_select(0, looked_at)
            with self._precision():
                picture = critic.embed(frames)
            advantage[looked_at] = equations.q_advantage(
                critic.value(picture, batch.actions[looked_at]),
                critic.value(picture, own_actions[looked_at]),
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


def _differentiate(loss: Tensor, module: torch.nn.Module) -> None:
    """Set the gradients of one module's parameters, and of no other's."""
    parameters = list(module.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
