"""The learner: twin delayed DDPG with human guidance (algorithm 1), one update at a time.

Each network embeds a picture once; ``trainer/tests/test_reference.py`` has the same algorithm
written plainly.
"""

import copy
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from trainer.learner import equations, networks
from trainer.learner.config import OVERRULED_ACTION, Algorithm, LearnerConfig
from trainer.learner.networks import FRAMES_SPACE, Actor, CriticPair, tensors
from trainer.learner.replay import Batch


class Losses(NamedTuple):
    """Figures of one update; ``priorities`` are the batch's new ones (eq. 21)."""

    critic_loss: float
    policy_loss: float
    cloning_loss: float
    value: float  # Mean Q_1 of the batch
    priorities: NDArray[np.float64]


def charges_overruled(config: LearnerConfig, algorithm: Algorithm) -> bool:
    """Whether an intervention's penalty goes to the overruled action, not the human's (eq. 17)."""
    return algorithm.penalty and config.penalty_on == OVERRULED_ACTION


NETWORKS = ("actor", "critics", "target_actor", "target_critics")
OPTIMISERS = ("actor_optimiser", "critic_optimiser", "cloning_optimiser")
MOST_BATCHES = 3000  # By which a fresh actor is fitted


def _values(critics: networks.CriticPair, pictures: list[Tensor], actions: Tensor) -> list[Tensor]:
    """Return Q_1 and Q_2, each [n], from the pictures that the two critics have embedded."""
    pairs = zip(critics.pair, pictures, strict=True)
    return [critic.value(picture, actions) for critic, picture in pairs]


class TD3Learner:
    """Actor, two critics, their targets and optimisers.

    Both losses are computed before either optimiser steps, so that every term shares one embedding
    of a picture by each network. ``seed`` is that of the initial weights and the smoothing noise.
    """

    def __init__(
        self,
        config: LearnerConfig,
        algorithm: Algorithm,
        seed: int,
        action_size: int = 1,
        device: str = "cpu",
        space: Space[Any] = FRAMES_SPACE,
    ) -> None:
        self.config, self.algorithm, self.device = config, algorithm, torch.device(device)
        if self.device.type == "cuda":
            _calculate_exactly()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self._make_actor = partial(Actor, action_size, config.frames, space)
            self.actor = self._make_actor().to(self.device)
            critics = CriticPair(
                action_size, config.frames, config.action_bound, config.critic_norm, space
            )
            self.critics = critics.to(self.device)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = torch.optim.Adam(
            self.actor.parameters(), config.actor_learning_rate, fused=True
        )
        self.critic_optimiser = torch.optim.Adam(
            self.critics.parameters(), config.critic_learning_rate, fused=True
        )
        self.cloning_optimiser = torch.optim.Adam(
            self.actor.parameters(), config.cloning_learning_rate, fused=True
        )
        for optimiser in (getattr(self, name) for name in OPTIMISERS):
            for group in optimiser.param_groups:
                group["decayed_lr"] = group["lr"]
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.updates = 0
        self._fade = 1.0  # Of the weight on cloning
        # bfloat16 has 8 bits of precision: enough for pixels, too few for numbers.
        self._reduces = isinstance(space, Box) and networks.is_picture(space.dtype, space.shape)
        self._charges_overruled = charges_overruled(config, algorithm)

    @torch.no_grad()
    def doubt(self, frames: NDArray[Any], action: NDArray[np.float32]) -> float:
        """Return |Q_1 - Q_2|, the critics' disagreement about an action in one observation."""
        seen, actions = tensors(frames[None], self.device), self._tensor(action[None])
        one, other = (critic.value(critic.picture(*seen), actions) for critic in self.critics.pair)
        return float((one - other).abs())

    def fit_numbers(self, observations: NDArray[Any]) -> None:
        """Scale the numbers that all networks see by their spread in observations [n, ...]."""
        for name in NETWORKS:
            networks.fit_numbers(getattr(self, name), observations)

    @torch.no_grad()
    def rescale_values(self, factor: float) -> None:
        """Multiply what the critics answer, after the unit of the rewards has changed."""
        for critic in (*self.critics.pair, *self.target_critics.pair):
            critic.head.output.weight.mul_(factor)
            critic.head.output.bias.mul_(factor)

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """Take one step of algorithm 1 on a minibatch; ``beta`` is eq. 15's exponent."""
        c = self.config
        self.updates += 1
        with_policy = self.updates % c.policy_delay == 0
        batch = replace(
            batch, frames=self._shift(batch.frames), next_frames=self._shift(batch.next_frames)
        )
        seen, actions = tensors(batch.frames, self.device), self._tensor(batch.actions)
        human = self._tensor(batch.human)
        targets = self._targets(batch)
        with self._precision():
            pictures = [critic.picture(*seen) for critic in self.critics.pair]
            own_picture = self.actor.picture(*seen)
        critic_loss, errors, value = self._critic_loss(batch, pictures, actions, targets, beta)
        score = self.actor.head(own_picture)
        own_actions = torch.tanh(score)
        judged = self._judge(seen, actions, human, own_actions.detach())
        policy = self._policy_loss(pictures[0].detach(), own_actions, human)
        cloning = self._cloning_loss(batch.shown, own_actions, actions, human, judged)
        priorities = self._priorities(errors, judged, human)
        if self.algorithm.foresight and batch.foreseen is not None:
            policy = policy + self._preference_loss(batch.foreseen)

        _differentiate(critic_loss, self.critics)
        if with_policy:
            self._step_actor(policy, cloning, score, apart=batch.shown is not None)
        self.critic_optimiser.step()
        if with_policy:
            self._update_targets()
        critics, actor, clone, mean = (one.item() for one in (critic_loss, policy, cloning, value))
        return Losses(critics, actor, clone, mean, priorities.double().cpu().numpy())

    def _step_actor(self, policy: Tensor, cloning: Tensor, score: Tensor, apart: bool) -> None:
        """Step by both terms of eq. 23; ``apart``: by an optimiser each."""
        c, row = self.config, self.algorithm
        saturation = c.saturation_weight * score.square().mean() if c.saturation_weight else 0.0
        if not apart:
            loss = policy + self._fade * c.cloning_weight * cloning + saturation
            _differentiate(loss, self.actor)
            self.actor_optimiser.step()
            return
        parameters = list(self.actor.parameters())
        towards_human = torch.autograd.grad(cloning, parameters)
        if row.q_term or row.foresight:
            _differentiate(policy + saturation, self.actor)
            self.actor_optimiser.step()
        for parameter, gradient in zip(parameters, towards_human, strict=True):
            parameter.grad = gradient
        self.cloning_optimiser.step()

    def begin_actor_anew(self, batches: Iterable[Batch]) -> None:
        """Put a fresh actor in place, fitted to batches of the human's actions.

        To as many as there were updates, and at most ``MOST_BATCHES``.
        """
        c, most = self.config, min(self.updates, MOST_BATCHES)
        with torch.random.fork_rng():
            torch.manual_seed(self.updates)
            fresh = self._make_actor().to(self.device)
        fresh.load_state_dict({**fresh.state_dict(), **dict(self.actor.named_buffers())})
        optimiser = torch.optim.Adam(fresh.parameters(), c.cloning_learning_rate, fused=True)
        for done, batch in enumerate(islice(batches, most)):
            optimiser.param_groups[0]["lr"] = c.cloning_learning_rate * (1 - done / most)
            seen, human = tensors(self._shift(batch.frames), self.device), self._tensor(batch.human)
            loss = equations.behaviour_cloning_loss(
                fresh(*seen), self._tensor(batch.actions), human, None, c.cloning_bound
            )
            _differentiate(loss, fresh)
            optimiser.step()
        for actor in (self.actor, self.target_actor):
            actor.load_state_dict(fresh.state_dict())
        self.actor_optimiser.state.clear()
        self.cloning_optimiser.state.clear()

    def decay(self, progress: float) -> None:
        """Decay both rates (table A5) and the weight on cloning after an episode.

        ``progress`` is the share of the run.
        """
        c = self.config
        if c.cloning_share:
            self._fade = max(0.0, 1.0 - progress / c.cloning_share)
        left = 1.0 - (1.0 - c.learning_rate_final) * min(progress, 1.0)
        for optimiser in (getattr(self, name) for name in OPTIMISERS):
            for group in optimiser.param_groups:
                group["decayed_lr"] *= c.learning_rate_decay
                group["lr"] = group["decayed_lr"] * left
        for group in self.cloning_optimiser.param_groups:
            group["lr"] *= self._fade

    def state_dict(self) -> dict[str, Any]:
        """Return weights, optimisers, noise and counters: all that a resumed run needs."""
        parts = {name: getattr(self, name).state_dict() for name in (*NETWORKS, *OPTIMISERS)}
        counted = {"updates": self.updates, "fade": self._fade}
        return {**parts, "noise": self.noise.get_state(), **counted}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        for name in (*NETWORKS, *OPTIMISERS):
            # A copy, because optimisers keep the tensors that they are given.
            getattr(self, name).load_state_dict(copy.deepcopy(state[name]))
        for weights, kept in chain(*(getattr(self, name).state.items() for name in OPTIMISERS)):
            if not kept["exp_avg"].shape == kept["exp_avg_sq"].shape == weights.shape:
                # torch does not check.
                raise ValueError("an optimiser's state is of other weights")
        self.noise.set_state(state["noise"])
        self.updates, self._fade = state["updates"], state["fade"]

    def _precision(self) -> torch.autocast:
        kind = self.device.type
        reduced = self.config.precision == "bfloat16" and self._reduces
        enabled = reduced and networks.bfloat16_is_faster(kind)
        return torch.autocast(kind, torch.bfloat16, enabled=enabled)

    def _tensor(self, column: NDArray[Any]) -> Tensor:
        return torch.from_numpy(column).to(self.device)

    def _shift(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Shift each picture [n, 2, 45, 80] at random by a few pixels, repeating its border.

        By at most an eighth of a picture's shorter side. Numbers stay as they are.
        """
        if frames.dtype.names:
            moved = frames.copy()
            for name in frames.dtype.names:
                moved[name] = self._shift(frames[name])
            return moved
        if not networks.is_picture(frames.dtype, frames.shape[1:]):
            return frames
        if frames.ndim == 3:
            return self._shift(frames[:, None])[:, 0]
        if networks.channels_last(frames.shape[1:]):
            return np.moveaxis(self._shift(np.moveaxis(frames, -1, 1)), 1, -1)
        most = min(self.config.picture_shift, min(frames.shape[2:]) // 8)
        if not most:
            return frames
        padded = np.pad(frames, ((0, 0), (0, 0), (most, most), (most, most)), "edge")
        corners = torch.randint(
            2 * most + 1, (len(frames), 2), generator=self.noise, device=self.device
        )
        top, left = corners.cpu().numpy().T
        windows = sliding_window_view(padded, frames.shape[2:], (2, 3))
        return windows[np.arange(len(frames)), :, top, left]

    @torch.no_grad()
    def _targets(self, batch: Batch) -> Tensor:
        c, seen = self.config, tensors(batch.next_frames, self.device)
        with self._precision():
            own_picture = self.target_actor.picture(*seen)
            pictures = [critic.picture(*seen) for critic in self.target_critics.pair]
        next_actions = torch.tanh(self.target_actor.head(own_picture))
        noise = c.target_noise * torch.randn(
            next_actions.shape, generator=self.noise, device=self.device
        )
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = _values(self.target_critics, pictures, next_actions)
        rewards, terminals = self._tensor(batch.rewards), self._tensor(batch.terminals)
        discount = c.gamma ** torch.as_tensor(batch.spans, device=self.device)
        return equations.td_target(rewards, terminals, (first, second), discount)

    def _critic_loss(
        self, batch: Batch, pictures: list[Tensor], actions: Tensor, targets: Tensor, beta: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return both critics' loss, the errors [n] for the priorities, and the mean value."""
        c, human = self.config, self._tensor(batch.human)
        weights = equations.importance_weights(
            self._tensor(batch.probabilities).float(), beta, c.normalise_importance
        )
        values = _values(self.critics, pictures, actions)
        first, second = (
            equations.critic_loss(value, targets, human, weights, c.split_loss) for value in values
        )
        loss, errors, mean = first + second, targets - values[0].detach(), values[0].detach().mean()
        if self._charges_overruled and batch.penalised.any():
            penalised = self._tensor(batch.penalised)
            overruled = _values(self.critics, pictures, self._tensor(batch.overruled))
            first, second = (
                equations.overruled_loss(value, penalised, c.intervention_penalty, weights)
                for value in overruled
            )
            loss = loss + first + second
            # The larger of the two actions' errors decides the row's priority.
            missed = (c.intervention_penalty - overruled[0].detach()) * penalised
            errors = torch.where(missed.abs() > errors.abs(), missed, errors)
        if self.algorithm.proxy_values and batch.human.any():
            overruled = _values(self.critics, pictures, self._tensor(batch.overruled))
            for pair in zip(values, overruled, strict=True):
                loss = loss + equations.proxy_value_loss(*pair, human)
        return loss, errors, mean

    def _policy_loss(self, picture: Tensor, own_actions: Tensor, human: Tensor) -> Tensor:
        """Return eq. 23's first term; without cloning it has all samples."""
        if not self.algorithm.q_term:
            return torch.zeros((), device=self.device)
        values = self.critics.first.value(picture, own_actions)
        split = self.config.split_loss and self.algorithm.behaviour_cloning
        return equations.policy_loss(values, human, split)

    def _cloning_loss(
        self,
        shown: Batch | None,
        own_actions: Tensor,
        actions: Tensor,
        human: Tensor,
        judged: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Return eq. 23's second term, unweighted: of ``shown``, else of the minibatch."""
        row = self.algorithm
        if not row.behaviour_cloning:
            return torch.zeros((), device=self.device)
        if shown is not None:
            seen = tensors(self._shift(shown.frames), self.device)
            actions, human = self._tensor(shown.actions), self._tensor(shown.human)
            with self._precision():
                picture = self.actor.picture(*seen)
            own_actions = torch.tanh(self.actor.head(picture))
            if row.weighted_cloning:
                judged = self._judge(seen, actions, human, own_actions.detach())
        weights = equations.cloning_weights(*judged) if row.weighted_cloning else None
        bound = self.config.cloning_bound
        return equations.behaviour_cloning_loss(own_actions, actions, human, weights, bound)

    def _preference_loss(self, foreseen: Batch) -> Tensor:
        """Prefer the human's action in the states to which the overruled one would have led."""
        seen = tensors(self._shift(foreseen.next_frames), self.device)
        with self._precision():
            picture = self.actor.picture(*seen)
        actions = torch.tanh(self.actor.head(picture))
        preferred, overruled = map(self._tensor, (foreseen.actions, foreseen.overruled))
        return equations.preference_loss(actions, preferred, overruled, self.config.preference_beta)

    @torch.no_grad()
    def _judge(
        self, seen: list[Tensor], actions: Tensor, human: Tensor, own_actions: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return Q'(s, a) and Q'(s, pi(s)), [n] each, of the human's samples; 0 of the others."""
        row, values = self.algorithm, torch.zeros((2, len(human)), device=self.device)
        looked_at = human.nonzero()[:, 0]
        if (row.advantage_weight or row.weighted_cloning) and len(looked_at):
            critic = self.target_critics.first
            # Copies picture by picture; [looked_at] copies byte by byte, 25 times as slow.
            with self._precision():
                picture = critic.picture(*(entry.index_select(0, looked_at) for entry in seen))
            for value, chosen in zip(values, (actions, own_actions), strict=True):
                value[looked_at] = critic.value(picture, chosen[looked_at])
        return values[0], values[1]

    def _priorities(self, errors: Tensor, judged: tuple[Tensor, Tensor], human: Tensor) -> Tensor:
        """Return eq. 21's priorities."""
        c, row = self.config, self.algorithm
        advantage = equations.q_advantage(*judged, c.advantage_bound)
        scheme = row.td_weight, row.human_td_weight, row.advantage_weight
        return equations.priority(errors, advantage, human, c.priority_offset, *scheme)

    @torch.no_grad()
    def _update_targets(self) -> None:
        pairs = (self.actor, self.target_actor), (self.critics, self.target_critics)
        for online, target in pairs:
            moved: list[Tensor] = list(target.parameters())
            torch._foreach_lerp_(moved, list[Tensor](online.parameters()), self.config.tau)


def _differentiate(loss: Tensor, module: torch.nn.Module) -> None:
    """Set the gradients of this module's parameters only."""
    parameters = list(module.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient


def _calculate_exactly() -> None:
    """Make float32 products exact and deterministic: a resumed run equals an unbroken one."""
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.deterministic = True
