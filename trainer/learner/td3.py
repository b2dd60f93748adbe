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
        """Wait for what ``TD3Learner.begin`` gave."""
        found = figures.double().cpu().numpy()
        critic, policy, cloning, value = map(float, found[:4])
        return cls(critic, policy, cloning, value, found[4:])


class Choices(NamedTuple):
    """Observations, the human's action in each, and the overruled one."""

    seen: list[Tensor]
    actions: Tensor
    overruled: Tensor


class Tensors(NamedTuple):
    """What a step needs of a ``Batch`` of ``n``, each [n, ...]."""

    seen: list[Tensor]
    actions: Tensor
    rewards: Tensor
    next_seen: list[Tensor]
    discount: Tensor  # gamma ^ spans
    terminals: Tensor
    human: Tensor
    importance: Tensor  # The weights of eq. 15
    looked_at: Tensor  # Rows whose Q advantage is wanted
    overruled: Tensor | None
    penalised: Tensor
    cloning_weight: Tensor  # Of this update, []
    shown: Choices | None
    foreseen: Choices | None


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
        self.actor_optimiser = self._adam(self.actor, config.actor_learning_rate)
        self.critic_optimiser = self._adam(self.critics, config.critic_learning_rate)
        self.cloning_optimiser = self._adam(self.actor, config.cloning_learning_rate)
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.updates = 0
        self.recorded: dict[tuple[bool, ...], RecordedStep] = {}
        """Kind of step -> what a GPU replays; forgotten where optimisers get new tensors."""
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
        return Losses.of(self.begin(batch, beta))

    def begin(self, batch: Batch, beta: float = 0.0) -> Tensor:
        """Begin that step; on a GPU it goes on by itself until ``Losses.of`` waits for it."""
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

        A processor leaves out what has no effect. A GPU's step is recorded, so it has one shape.
        """
        c, column, everything = self.config, torch.from_numpy, self._on_gpu
        charged = self._charges_overruled and (everything or batch.penalised.any())
        valued = self.algorithm.proxy_values and (everything or batch.human.any())
        judged = np.arange(len(batch.human)) if everything else np.flatnonzero(batch.human)
        probabilities = column(batch.probabilities).float()
        shown, foreseen = batch.shown, batch.foreseen if self.algorithm.foresight else None

        def choices(frames: NDArray[Any], batch: Batch) -> Choices:
            return Choices(tensors(frames), column(batch.actions), column(batch.overruled))

        return Tensors(
            seen=tensors(batch.frames),
            actions=column(batch.actions),
            rewards=column(batch.rewards),
            next_seen=tensors(batch.next_frames),
            discount=c.gamma ** column(batch.spans),
            terminals=column(batch.terminals),
            human=column(batch.human),
            importance=equations.importance_weights(probabilities, beta, c.normalise_importance),
            looked_at=column(judged),
            overruled=column(batch.overruled) if charged or valued else None,
            penalised=column(batch.penalised),
            cloning_weight=torch.tensor(self._fade * c.cloning_weight),
            shown=None if shown is None else choices(shown.frames, shown),
            foreseen=None if foreseen is None else choices(foreseen.next_frames, foreseen),
        )

    def _step(self, batch: Tensors, with_policy: bool) -> Tensor:
        """Take a step; return the four losses and the batch's new priorities, [4 + n]."""
        batch = batch._replace(
            seen=self._shifted(batch.seen), next_seen=self._shifted(batch.next_seen)
        )
        targets = self._targets(batch)
        with self._precision():
            pictures = [critic.picture(*batch.seen) for critic in self.critics.pair]
            own_picture = self.actor.picture(*batch.seen)
        critic_loss, errors, value = self._critic_loss(batch, pictures, targets)
        score = self.actor.head(own_picture)
        own_actions = torch.tanh(score)
        judged = self._judge(batch.seen, batch.actions, batch.looked_at, own_actions.detach())
        policy = self._policy_loss(pictures[0].detach(), own_actions, batch.human)
        cloning = self._cloning_loss(batch, own_actions, judged)
        priorities = self._priorities(errors, judged, batch.human)
        if batch.foreseen is not None:
            policy = policy + self._preference_loss(batch.foreseen)

        _differentiate(critic_loss, self.critics)
        if with_policy:
            self._step_actor(batch, policy, cloning, score)
        self.critic_optimiser.step()
        if with_policy:
            self._update_targets()
        losses = torch.stack([critic_loss, policy, cloning, value]).detach()
        return torch.cat([losses, priorities])

    def _step_actor(self, batch: Tensors, policy: Tensor, cloning: Tensor, score: Tensor) -> None:
        """Step by both terms of eq. 23; where imitation has a batch, by an optimiser each."""
        c, row = self.config, self.algorithm
        saturation = c.saturation_weight * score.square().mean() if c.saturation_weight else 0.0
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
            seen = self._shifted(tensors(batch.frames, self.device))
            human = self._tensor(batch.human)
            loss = equations.behaviour_cloning_loss(
                fresh(*seen), self._tensor(batch.actions), human, None, c.cloning_bound
            )
            _differentiate(loss, fresh)
            optimiser.step()
        for actor in (self.actor, self.target_actor):
            actor.load_state_dict(fresh.state_dict())
        self.actor_optimiser.state.clear()
        self.cloning_optimiser.state.clear()
        self.recorded.clear()

    def decay(self, progress: float) -> None:
        """Decay both rates (table A5) and the weight on cloning after an episode.

        ``progress`` is the share of the run.
        """
        c = self.config
        if c.cloning_share:
            self._fade = max(0.0, 1.0 - progress / c.cloning_share)
        left = 1.0 - (1.0 - c.learning_rate_final) * min(progress, 1.0)
        for name in OPTIMISERS:
            fade = self._fade if name == "cloning_optimiser" else 1.0
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
        for group in chain(*(getattr(self, name).param_groups for name in OPTIMISERS)):
            group |= {"lr": self._rate(float(group["lr"])), "capturable": self._on_gpu}
        self.recorded.clear()
        self.noise.set_state(state["noise"])
        self.updates, self._fade = state["updates"], state["fade"]

    def _adam(self, network: torch.nn.Module, rate: float) -> torch.optim.Adam:
        made = torch.optim.Adam(
            network.parameters(), self._rate(rate), fused=True, capturable=self._on_gpu
        )
        made.param_groups[0]["decayed_lr"] = rate
        return made

    def _rate(self, rate: float) -> float | Tensor:
        """Return a learning rate as Adam keeps it; a recorded step reads it from a tensor."""
        return torch.tensor(rate, device=self.device) if self._on_gpu else rate

    @property
    def _on_gpu(self) -> bool:
        return self.device.type == "cuda"

    def _precision(self) -> torch.autocast:
        kind = self.device.type
        reduced = self.config.precision == "bfloat16" and self._reduces
        enabled = reduced and networks.bfloat16_is_faster(kind)
        # A recorded step must not begin with weights that were cast before it.
        return torch.autocast(kind, torch.bfloat16, enabled, cache_enabled=not self._on_gpu)

    def _tensor(self, column: NDArray[Any]) -> Tensor:
        return torch.from_numpy(column).to(self.device)

    def _shifted(self, seen: list[Tensor]) -> list[Tensor]:
        return [self._shift(entry) for entry in seen]

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
            own_picture = self.target_actor.picture(*batch.next_seen)
            pictures = [critic.picture(*batch.next_seen) for critic in self.target_critics.pair]
        next_actions = torch.tanh(self.target_actor.head(own_picture))
        noise = c.target_noise * torch.randn(
            next_actions.shape, generator=self.noise, device=self.device
        )
        next_actions = equations.smoothed_target_action(next_actions, noise, c.target_noise_bound)
        first, second = _values(self.target_critics, pictures, next_actions)
        values = first, second
        return equations.td_target(batch.rewards, batch.terminals, values, batch.discount)

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
            missed = (c.intervention_penalty - overruled[0].detach()) * batch.penalised
            errors = torch.where(missed.abs() > errors.abs(), missed, errors)
        if self.algorithm.proxy_values:
            for pair in zip(values, overruled, strict=True):
                loss = loss + equations.proxy_value_loss(*pair, batch.human)
        return loss, errors, mean

    def _policy_loss(self, picture: Tensor, own_actions: Tensor, human: Tensor) -> Tensor:
        """Return eq. 23's first term; without cloning it has all samples."""
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
            seen, actions = self._shifted(batch.shown.seen), batch.shown.actions
            human = torch.ones(len(actions), dtype=torch.bool, device=self.device)
            with self._precision():
                picture = self.actor.picture(*seen)
            own_actions = torch.tanh(self.actor.head(picture))
            if row.weighted_cloning:
                everyone = torch.arange(len(actions), device=self.device)
                judged = self._judge(seen, actions, everyone, own_actions.detach())
        weights = equations.cloning_weights(*judged) if row.weighted_cloning else None
        bound = self.config.cloning_bound
        return equations.behaviour_cloning_loss(own_actions, actions, human, weights, bound)

    def _preference_loss(self, foreseen: Choices) -> Tensor:
        """Prefer the human's action in the states to which the overruled one would have led."""
        seen = self._shifted(foreseen.seen)
        with self._precision():
            picture = self.actor.picture(*seen)
        actions = torch.tanh(self.actor.head(picture))
        beta = self.config.preference_beta
        return equations.preference_loss(actions, foreseen.actions, foreseen.overruled, beta)

    @torch.no_grad()
    def _judge(
        self, seen: list[Tensor], actions: Tensor, looked_at: Tensor, own_actions: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return Q'(s, a) and Q'(s, pi(s)), [n] each, of the rows to look at; 0 of the others."""
        row, values = self.algorithm, torch.zeros((2, len(actions)), device=self.device)
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
