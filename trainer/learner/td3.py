"""The learner: twin delayed DDPG with human guidance (algorithm 1), one update at a time.

Each network embeds a picture once; ``trainer/tests/test_reference.py`` has the same algorithm
written plainly.
"""

import copy
from collections.abc import Iterable
from functools import partial
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from torch import Tensor

from trainer.learner import equations, networks
from trainer.learner.config import OVERRULED_ACTION, Algorithm, LearnerConfig
from trainer.learner.networks import FRAMES_SPACE, Actor, CriticPair, tensors
from trainer.learner.recorded import RecordedStep
from trainer.learner.replay import Batch


class Losses(NamedTuple):
    """Figures of one update; ``priorities`` are the batch's new ones (eq. 21)."""

    critic_loss: float
    policy_loss: float
    cloning_loss: float
    value: float  # Mean Q_1 of the batch
    priorities: NDArray[np.float64]

    @classmethod
    def of(cls, figures: Tensor) -> "Losses":
        """Wait for the result of ``TD3Learner.begin`` and read it."""
        numbers = figures.double().cpu().numpy()
        critic, policy, cloning, value = map(float, numbers[:4])
        return cls(critic, policy, cloning, value, numbers[4:])


class Choices(NamedTuple):
    """Observations, the human's action in each, and the overruled one."""

    entries: list[Tensor]  # Of the observations
    actions: Tensor
    overruled: Tensor


class Tensors(NamedTuple):
    """A ``Batch`` of ``n`` as tensors, each [n, ...]."""

    entries: list[Tensor]  # Of the observations
    actions: Tensor
    rewards: Tensor
    next_entries: list[Tensor]
    discount: Tensor  # gamma ^ spans
    terminals: Tensor
    human: Tensor
    importance: Tensor  # The weights of eq. 15
    judged_rows: Tensor  # Rows whose Q advantage is computed
    overruled: Tensor | None
    penalised: Tensor
    cloning_weight: Tensor  # In this update, []
    shown: Choices | None
    foreseen: Choices | None


def charges_overruled(config: LearnerConfig, algorithm: Algorithm) -> bool:
    """Whether an intervention's penalty goes to the overruled action, not the human's (eq. 17)."""
    return algorithm.penalty and config.penalty_on == OVERRULED_ACTION


NETWORKS = ("actor", "critics", "target_actor", "target_critics")
OPTIMISERS = ("actor_optimiser", "critic_optimiser", "cloning_optimiser")
MOST_BATCHES = 3000  # Limit of the batches that a fresh actor is fitted to


def _values(critics: networks.CriticPair, pictures: list[Tensor], actions: Tensor) -> list[Tensor]:
    """Return Q_1 and Q_2, each [n], from the two critics' embedded pictures."""
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
        self.actor_optimiser = self._adam(self.actor, config.actor_learning_rate)
        self.critic_optimiser = self._adam(self.critics, config.critic_learning_rate)
        self.cloning_optimiser = self._adam(self.actor, config.cloning_learning_rate)
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.updates = 0
        self.recorded: dict[tuple[bool, ...], RecordedStep] = {}
        """Kind of step -> its GPU recording; cleared whenever optimisers get new tensors."""
        self._cloning_fade = 1.0  # Factor on the cloning weight
        # bfloat16 has 8 bits of precision: enough for pixels, too few for numbers.
        self._only_pixels = isinstance(space, Box) and networks.is_picture(space.dtype, space.shape)
        self._charges_overruled = charges_overruled(config, algorithm)

    @torch.no_grad()
    def doubt(self, frames: NDArray[Any], action: NDArray[np.float32]) -> float:
        """Return |Q_1 - Q_2|, the critics' disagreement about an action in one observation."""
        entries, actions = tensors(frames[None], self.device), self._tensor(action[None])
        pictures = [critic.picture(*entries) for critic in self.critics.pair]
        first, second = _values(self.critics, pictures, actions)
        return float((first - second).abs())

    def fit_numbers(self, observations: NDArray[Any]) -> None:
        """Fit the scales of all networks' input numbers to observations [n, ...]."""
        for name in NETWORKS:
            networks.fit_numbers(getattr(self, name), observations)

    @torch.no_grad()
    def rescale_values(self, factor: float) -> None:
        """Multiply the critics' outputs, after the unit of the rewards has changed."""
        for critic in (*self.critics.pair, *self.target_critics.pair):
            critic.head.output.weight.mul_(factor)
            critic.head.output.bias.mul_(factor)

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        """Take one step of algorithm 1 on a minibatch; ``beta`` is eq. 15's exponent."""
        return Losses.of(self.begin(batch, beta))

    def begin(self, batch: Batch, beta: float = 0.0) -> Tensor:
        """Start that step; a GPU works on it until ``Losses.of`` waits for the result."""
        self.updates += 1
        with_policy = self.updates % self.config.policy_delay == 0
        prepared = self._prepare(batch, beta)
        if not self._on_gpu:
            return self._step(prepared, with_policy)
        kind = with_policy, prepared.shown is not None, prepared.foreseen is not None
        if kind not in self.recorded:
            step = partial(self._step, with_policy=with_policy)
            self.recorded[kind] = RecordedStep(step, self.noise)
        return self.recorded[kind](prepared)

    def _prepare(self, batch: Batch, beta: float) -> Tensors:
        """Turn a batch into tensors, in the processor's memory.

        The CPU leaves out terms without effect. A GPU's step is recorded, so its shapes are fixed.
        """
        c, column, all_rows = self.config, torch.from_numpy, self._on_gpu
        charged = self._charges_overruled and (all_rows or batch.penalised.any())
        valued = self.algorithm.proxy_values and (all_rows or batch.human.any())
        judged = np.arange(len(batch.human)) if all_rows else np.flatnonzero(batch.human)
        probabilities = column(batch.probabilities).float()
        shown, foreseen = batch.shown, batch.foreseen if self.algorithm.foresight else None

        def choices(frames: NDArray[Any], batch: Batch) -> Choices:
            return Choices(tensors(frames), column(batch.actions), column(batch.overruled))

        return Tensors(
            entries=tensors(batch.frames),
            actions=column(batch.actions),
            rewards=column(batch.rewards),
            next_entries=tensors(batch.next_frames),
            discount=c.gamma ** column(batch.spans),
            terminals=column(batch.terminals),
            human=column(batch.human),
            importance=equations.importance_weights(probabilities, beta, c.normalise_importance),
            judged_rows=column(judged),
            overruled=column(batch.overruled) if charged or valued else None,
            penalised=column(batch.penalised),
            cloning_weight=torch.tensor(self._cloning_fade * c.cloning_weight),
            shown=None if shown is None else choices(shown.frames, shown),
            foreseen=None if foreseen is None else choices(foreseen.next_frames, foreseen),
        )

    def _step(self, batch: Tensors, with_policy: bool) -> Tensor:
        """Take a step; return the four losses and the batch's new priorities, [4 + n]."""
        entries, next_entries = self._shifted(batch.entries), self._shifted(batch.next_entries)
        batch = batch._replace(entries=entries, next_entries=next_entries)
        targets = self._targets(batch)
        with self._precision():
            pictures = [critic.picture(*batch.entries) for critic in self.critics.pair]
            own_picture = self.actor.picture(*batch.entries)
        critic_loss, errors, value = self._critic_loss(batch, pictures, targets)
        pre_tanh = self.actor.head(own_picture)
        own_actions = torch.tanh(pre_tanh)
        judged = self._judge(batch.entries, batch.actions, batch.judged_rows, own_actions.detach())
        policy = self._policy_loss(pictures[0].detach(), own_actions, batch.human)
        cloning = self._cloning_loss(batch, own_actions, judged)
        priorities = self._priorities(errors, judged, batch.human)
        if batch.foreseen is not None:
            policy = policy + self._preference_loss(batch.foreseen)

        _differentiate(critic_loss, self.critics)
        if with_policy:
            self._step_actor(batch, policy, cloning, pre_tanh)
        self.critic_optimiser.step()
        if with_policy:
            self._update_targets()
        losses = torch.stack([critic_loss, policy, cloning, value]).detach()
        return torch.cat([losses, priorities])

    def _step_actor(
        self, batch: Tensors, policy: Tensor, cloning: Tensor, pre_tanh: Tensor
    ) -> None:
        """Step by both terms of eq. 23, each with its optimiser if cloning has its own batch."""
        c, row = self.config, self.algorithm
        saturation = c.saturation_weight * pre_tanh.square().mean() if c.saturation_weight else 0.0
        if batch.shown is None:
            loss = policy + batch.cloning_weight * cloning + saturation
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
        """Replace the actor by a fresh one, fitted to batches of the human's actions.

        It takes as many batches as there were updates, at most ``MOST_BATCHES``.
        """
        c, most = self.config, min(self.updates, MOST_BATCHES)
        with torch.random.fork_rng():
            torch.manual_seed(self.updates)
            fresh = self._make_actor().to(self.device)
        fresh.load_state_dict({**fresh.state_dict(), **dict(self.actor.named_buffers())})
        optimiser = torch.optim.Adam(fresh.parameters(), c.cloning_learning_rate, fused=True)
        for done, batch in enumerate(islice(batches, most)):
            optimiser.param_groups[0]["lr"] = c.cloning_learning_rate * (1 - done / most)
            entries = self._shifted(tensors(batch.frames, self.device))
            human = self._tensor(batch.human)
            loss = equations.behaviour_cloning_loss(
                fresh(*entries), self._tensor(batch.actions), human, None, c.cloning_bound
            )
            _differentiate(loss, fresh)
            optimiser.step()
        for actor in (self.actor, self.target_actor):
            actor.load_state_dict(fresh.state_dict())
        self.actor_optimiser.state.clear()
        self.cloning_optimiser.state.clear()
        self.recorded.clear()

    def decay(self, progress: float) -> None:
        """Decay the learning rates (table A5) and the cloning weight after an episode.

        ``progress`` is the share of the run that is done.
        """
        c = self.config
        if c.cloning_share:
            self._cloning_fade = max(0.0, 1.0 - progress / c.cloning_share)
        left = 1.0 - (1.0 - c.learning_rate_final) * min(progress, 1.0)
        for name in OPTIMISERS:
            fade = self._cloning_fade if name == "cloning_optimiser" else 1.0
            (group,) = getattr(self, name).param_groups
            group["decayed_lr"] *= c.learning_rate_decay
            rate = group["decayed_lr"] * left * fade
            if self._on_gpu:
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def state_dict(self) -> dict[str, Any]:
        """Return weights, optimisers, noise and counters: all that a resumed run needs."""
        parts = {name: getattr(self, name).state_dict() for name in (*NETWORKS, *OPTIMISERS)}
        counted = {"updates": self.updates, "fade": self._cloning_fade}
        return {**parts, "noise": self.noise.get_state(), **counted}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        for name in (*NETWORKS, *OPTIMISERS):
            # Copied, since optimisers keep the tensors that they load.
            getattr(self, name).load_state_dict(copy.deepcopy(state[name]))
        for weights, moments in chain(*(getattr(self, name).state.items() for name in OPTIMISERS)):
            if not moments["exp_avg"].shape == moments["exp_avg_sq"].shape == weights.shape:
                # torch does not check.
                raise ValueError("an optimiser's state does not fit the weights")
        for group in chain(*(getattr(self, name).param_groups for name in OPTIMISERS)):
            group |= {"lr": self._rate(float(group["lr"])), "capturable": self._on_gpu}
        self.recorded.clear()
        self.noise.set_state(state["noise"])
        self.updates, self._cloning_fade = state["updates"], state["fade"]

    def _adam(self, network: torch.nn.Module, rate: float) -> torch.optim.Adam:
        optimiser = torch.optim.Adam(
            network.parameters(), self._rate(rate), fused=True, capturable=self._on_gpu
        )
        optimiser.param_groups[0]["decayed_lr"] = rate
        return optimiser

    def _rate(self, rate: float) -> float | Tensor:
        """Return a learning rate in Adam's form; a recorded step must read it from a tensor."""
        return torch.tensor(rate, device=self.device) if self._on_gpu else rate

    @property
    def _on_gpu(self) -> bool:
        return self.device.type == "cuda"

    def _precision(self) -> torch.autocast:
        kind = self.device.type
        reduced = self.config.precision == "bfloat16" and self._only_pixels
        enabled = reduced and networks.bfloat16_is_faster(kind)
        # A recorded step must not begin with weights that were cast before it.
        return torch.autocast(kind, torch.bfloat16, enabled, cache_enabled=not self._on_gpu)

    def _tensor(self, column: NDArray[Any]) -> Tensor:
        return torch.from_numpy(column).to(self.device)

    def _shifted(self, entries: list[Tensor]) -> list[Tensor]:
        return [self._shift(entry) for entry in entries]

    def _shift(self, entry: Tensor) -> Tensor:
        """Shift each picture [n, 2, 45, 80] at random by a few pixels, repeating its border.

        By at most an eighth of a picture's shorter side. Numbers stay as they are.
        """
        if entry.dtype != torch.uint8 or entry.dim() not in (3, 4):
            return entry
        if entry.dim() == 3:
            return self._shift(entry[:, None])[:, 0]
        if networks.channels_last(entry.shape[1:]):
            return self._shift(entry.movedim(3, 1)).movedim(1, 3).contiguous()
        count, channels, *sides = entry.shape
        most = min(self.config.picture_shift, min(sides) // 8)
        if not most:
            return entry
        corners = torch.randint(2 * most + 1, (count, 2), generator=self.noise, device=self.device)
        rows, columns = (
            (torch.arange(side, device=self.device) + corner[:, None] - most).clamp(0, side - 1)
            for side, corner in zip(sides, corners.T, strict=True)
        )
        planes = torch.arange(count * channels, device=self.device).view(count, channels, 1)
        moved = entry.flatten(0, 2).index_select(0, (planes * sides[0] + rows[:, None]).flatten())
        moved = moved.view(count, -1, sides[1])
        return moved.gather(2, columns[:, None].expand_as(moved)).view(entry.shape)

    @torch.no_grad()
    def _targets(self, batch: Tensors) -> Tensor:
        c = self.config
        with self._precision():
            own_picture = self.target_actor.picture(*batch.next_entries)
            pictures = [critic.picture(*batch.next_entries) for critic in self.target_critics.pair]
        next_actions = torch.tanh(self.target_actor.head(own_picture))
        noise = c.target_noise * torch.randn(
            next_actions.shape, generator=self.noise, device=self.device
        )
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = _values(self.target_critics, pictures, next_actions)
        return equations.td_target(batch.rewards, batch.terminals, (first, second), batch.discount)

    def _critic_loss(
        self, batch: Tensors, pictures: list[Tensor], targets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return both critics' loss, the errors [n] for the priorities, and the mean value."""
        c, weights = self.config, batch.importance
        values = _values(self.critics, pictures, batch.actions)
        first, second = (
            equations.critic_loss(value, targets, batch.human, weights, c.split_loss)
            for value in values
        )
        loss, errors, mean = first + second, targets - values[0].detach(), values[0].detach().mean()
        if batch.overruled is None:
            return loss, errors, mean
        overruled = _values(self.critics, pictures, batch.overruled)
        if self._charges_overruled:
            first, second = (
                equations.overruled_loss(value, batch.penalised, c.intervention_penalty, weights)
                for value in overruled
            )
            loss = loss + first + second
            # The larger of the two actions' errors decides the row's priority.
            other = (c.intervention_penalty - overruled[0].detach()) * batch.penalised
            errors = torch.where(other.abs() > errors.abs(), other, errors)
        if self.algorithm.proxy_values:
            for pair in zip(values, overruled, strict=True):
                loss = loss + equations.proxy_value_loss(*pair, batch.human)
        return loss, errors, mean

    def _policy_loss(self, picture: Tensor, own_actions: Tensor, human: Tensor) -> Tensor:
        """Return eq. 23's first term; without cloning over all samples, even if split."""
        if not self.algorithm.q_term:
            return torch.zeros((), device=self.device)
        values = self.critics.first.value(picture, own_actions)
        split = self.config.split_loss and self.algorithm.behaviour_cloning
        return equations.policy_loss(values, human, split)

    def _cloning_loss(
        self, batch: Tensors, own_actions: Tensor, judged: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Return eq. 23's second term, unweighted: of ``batch.shown``, else of the minibatch."""
        row, actions, human = self.algorithm, batch.actions, batch.human
        if not row.behaviour_cloning:
            return torch.zeros((), device=self.device)
        if batch.shown is not None:
            entries, actions = self._shifted(batch.shown.entries), batch.shown.actions
            human = torch.ones(len(actions), dtype=torch.bool, device=self.device)
            with self._precision():
                picture = self.actor.picture(*entries)
            own_actions = torch.tanh(self.actor.head(picture))
            if row.weighted_cloning:
                all_rows = torch.arange(len(actions), device=self.device)
                judged = self._judge(entries, actions, all_rows, own_actions.detach())
        weights = equations.cloning_weights(*judged) if row.weighted_cloning else None
        bound = self.config.cloning_bound
        return equations.behaviour_cloning_loss(own_actions, actions, human, weights, bound)

    def _preference_loss(self, foreseen: Choices) -> Tensor:
        """Return the loss that prefers the human's action in the predicted states."""
        entries = self._shifted(foreseen.entries)
        with self._precision():
            picture = self.actor.picture(*entries)
        actions = torch.tanh(self.actor.head(picture))
        beta = self.config.preference_beta
        return equations.preference_loss(actions, foreseen.actions, foreseen.overruled, beta)

    @torch.no_grad()
    def _judge(
        self, entries: list[Tensor], actions: Tensor, rows: Tensor, own_actions: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return Q'(s, a) and Q'(s, pi(s)), [n] each, in ``rows``; 0 in the others."""
        row, values = self.algorithm, torch.zeros((2, len(actions)), device=self.device)
        if (row.advantage_weight or row.weighted_cloning) and len(rows):
            critic = self.target_critics.first
            # index_select copies picture by picture; entry[rows] byte by byte, 25 times as slow.
            with self._precision():
                picture = critic.picture(*(entry.index_select(0, rows) for entry in entries))
            for value, chosen in zip(values, (actions, own_actions), strict=True):
                value[rows] = critic.value(picture, chosen[rows])
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
