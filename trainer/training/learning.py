"""Replay and learner in a thread beside the environment: one update during each step.

The order is fixed, so that a run depends on its seed alone: in each control period the policy acts,
an update on the stored steps starts, the environment takes its step, the update finishes, and only
then the new step is stored. Beside a person the loop never waits (`UnhurriedLearning`).
"""

import copy
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import torch

from bridge.network import parse_spec
from edge_runtime.util import UserError
from trainer.environments import ticks_late
from trainer.learner import equations
from trainer.learner.config import HUMANS_ACTION, find_algorithm
from trainer.learner.replay import Action, Batch, Observation, ReplayBuffer, Transition
from trainer.learner.td3 import NETWORKS, Losses, TD3Learner, charges_overruled
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.util import Purpose, random_stream

LOSSES = Losses._fields[:4]  # Averaged over an episode
MOST_TO_FIT = 4096  # Observations to which the scales of numbers are fitted
USUAL_RETURN, USUAL_FACTOR = 10.0, 3.0
"""Returns within this factor of 10 are not rescaled."""
FRESH_BATCH_SIZE = 256
NICENESS = 10  # Of the learner's threads beside a person: the loop goes first


def diverged(what: str) -> UserError:
    hint = "a smaller --set actor_learning_rate or critic_learning_rate may help"
    return UserError(f"the training diverged, its {what} are no longer finite: {hint}")


class LearningThread:
    """A learner with its replay buffer; the updates run in a thread of their own.

    The policy acts in that thread, too: another would bring a second pool of OpenMP threads, and
    the two would fight for the same cores. The networks are on the config's device. The replay and
    the actor that acts are on the CPU, which answers a single observation sooner than a GPU.
    """

    def __init__(self, config: RunConfig, env: Any) -> None:
        self.config, self.algorithm = config.learner, find_algorithm(config.algorithm)
        c, row, action_size = self.config, self.algorithm, env.action_space.shape[0]
        self.learner = TD3Learner(
            c, row, config.seed, action_size, config.device, env.observation_space
        )
        try:
            self.replay = ReplayBuffer(
                c.replay_capacity, action_size, c.alpha, row.separate_buffers, c.return_steps,
                c.gamma, c.intervention_penalty if charges_overruled(c, row) else None,
                env.layout, row.human_share, bool(row.foresight),
                c.cloning_batch_size if row.behaviour_cloning else 0,
            )  # fmt: skip
        except MemoryError as error:
            raise UserError(f"replay_capacity {c.replay_capacity}: {error}") from None
        self._random = random_stream(config.seed, Purpose.REPLAY)
        late = ticks_late(parse_spec(config.latency), env.control_period_s)
        self._observations: deque[Observation] = deque(maxlen=late + 1)
        """The newest observations; behind the network the policy knows only the oldest of them."""
        # Adam's mean of a gradient that has become 0 stays denormal for ever. Denormal numbers add
        # nothing to a weight, but cost many times as long: 3 ms a step instead of 1. Flushed first
        # of all in this thread, so that the kernel's OpenMP threads inherit it.
        self._thread = ThreadPoolExecutor(1, "learner", torch.set_flush_denormal, (True,))
        self._acting = self.learner.actor
        if self.learner.device.type != "cpu":
            self._acting = copy.deepcopy(self._acting).cpu()
        self._begun: Future[tuple[list[Batch], list[Losses], float]] | None = None
        self._scenario = config.scenario
        self._fitted, self._renewed = False, 0
        """Whether the scales are fitted to the warm-up; number of fresh actors so far."""
        self._forget_losses()

    def act(self, observation: Observation) -> Action:
        return self.in_thread(self._acting.act, observation[None])[0]

    def doubt(self, observation: Observation, action: Action) -> float:
        """Return the critics' disagreement about an action; call it while no update runs."""
        return self.in_thread(self.learner.doubt, observation, action)

    def in_thread(self, work: Callable[..., Any], *arguments: Any) -> Any:
        return self._thread.submit(work, *arguments).result()

    def add(self, transition: Transition) -> None:
        """Store a transition, its reward shaped, its observations as late as the policy gets them.

        Behind a network an episode's first ones are left out: the policy had no observation yet.
        """
        self._observations.append(transition.observation)
        if len(self._observations) < (self._observations.maxlen or 1):
            return
        before, after, *_ = *self._observations, transition.next_observation
        ahead = [*self._observations, *transition.foreseen[1:]][: len(transition.foreseen)]
        # Eq. 17 as printed, unless the overruled action is charged
        reward = transition.reward if self.algorithm.rewarded else 0.0
        charged = transition.penalised and self.config.penalty_on == HUMANS_ACTION
        reward = equations.shaped_reward(reward, self.config.intervention_penalty, charged, False)
        self.replay.add(
            replace(transition, observation=before, reward=reward, next_observation=after,
                    foreseen=tuple(ahead))
        )  # fmt: skip

    def begin(self, beta: float) -> None:
        """Start one step's updates on the stored transitions; ``beta`` is eq. 15's exponent."""
        if not self._fitted:
            self.learner.fit_numbers(self.replay.observations(MOST_TO_FIT))
            self._scale_rewards()
            self._fitted = True
        self._begun = self._thread.submit(self._update, beta)

    def _scale_rewards(self) -> None:
        """Scale rewards so that the largest return is about 10, as in our scenarios.

        The losses' weights were chosen for that. Small returns are scaled up only before the first
        update: later, the first success may bring a large one.
        """
        if self._scenario in SCENARIOS:
            return
        scaled = self.replay.reward_scale * self.replay.largest_return
        small = 0.0 < scaled < USUAL_RETURN / USUAL_FACTOR and not self._fitted
        if small or scaled > USUAL_RETURN * USUAL_FACTOR:
            self.learner.rescale_values(USUAL_RETURN / scaled)
            self.replay.reward_scale *= USUAL_RETURN / scaled

    def finish(self) -> float:
        """Wait for the update under way, if any; return the seconds waited.

        Raises the update's own exception, or UserError if learning has diverged.
        """
        if self._begun is None:
            return 0.0
        began_s = time.perf_counter()
        update, self._begun = self._begun, None
        batches, done, learning_s = update.result()
        self._refresh_actor()
        if not all(np.isfinite(losses.priorities).all() for losses in done):
            raise diverged("losses")
        waited_s = time.perf_counter() - began_s
        self._waiting_s += waited_s
        self._learning_s += learning_s
        for batch, losses in zip(batches, done, strict=True):
            self._losses.append(losses[:4])
            self.replay.update_priorities(batch.indices, losses.priorities)
        return waited_s

    def end_episode(self, progress: float, keep: bool = True) -> dict[str, Any]:
        """Decay the learning rates; return the learner's fields of `EpisodeMetrics`.

        ``progress`` is the run's, 0 to 1. Losses are means since the last call, nan without update.
        ``keep`` is False if a person discards the episode; only `UnhurriedLearning` can forget it.
        """
        self.learner.decay(progress)
        self._begin_actor_anew(progress)
        means = np.mean(self._losses, axis=0) if self._losses else [math.nan] * len(LOSSES)
        names = (*LOSSES, "policy_priority", "human_priority")
        learned = {
            **dict(zip(names, map(float, (*means, *self.replay.mean_priorities())), strict=True)),
            "learning_s": self._learning_s,
            "waiting_s": self._waiting_s,
        }
        self._forget_losses()
        self.release(keep)
        if self._fitted:
            self._scale_rewards()
        return learned

    def _begin_actor_anew(self, progress: float) -> None:
        times = self.config.fresh_actors
        due = min(int(progress * (times + 1)), times)
        if due > self._renewed and self.replay.human_count:
            self._renewed = due
            self._fit_fresh_actor()

    def end_run(self) -> None:
        """Fit a last fresh actor, if the settings ask for it."""
        if self.config.fresh_actor_at_end and self.replay.human_count:
            self._fit_fresh_actor()

    def _fit_fresh_actor(self) -> None:
        batches = (self.replay.show(FRESH_BATCH_SIZE, self._random) for _ in count())
        self.in_thread(self.learner.begin_actor_anew, batches)
        self._refresh_actor()

    def release(self, keep: bool = True) -> None:
        """End the episode; `UnhurriedLearning` stores its steps now, if ``keep``."""
        self._observations.clear()
        self.replay.end_episode()

    def check_weights(self) -> None:
        """Raise UserError unless every weight is finite: no such checkpoint is kept."""
        networks = (getattr(self.learner, name) for name in NETWORKS)
        if not all(p.isfinite().all() for network in networks for p in network.parameters()):
            raise diverged("weights")

    def state_dict(self) -> dict[str, Any]:
        replay = {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
            for name, value in self.replay.state_dict().items()
        }
        drawing = self._random.bit_generator.state
        return {"learner": self.learner.state_dict(), "replay": replay, "drawing": drawing,
                "fitted": self._fitted, "renewed": self._renewed}  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.learner.load_state_dict(state["learner"])
        self.replay.load_state_dict(state["replay"])
        self._random.bit_generator.state = state["drawing"]
        self._fitted, self._renewed = state["fitted"], state["renewed"]
        self._refresh_actor()

    def close(self) -> None:
        self._thread.shutdown()

    def _update(self, beta: float) -> tuple[list[Batch], list[Losses], float]:
        """Draw minibatches and learn; a GPU learns from one while the next is drawn."""
        began_s = time.perf_counter()
        batches, begun = list[Batch](), list[torch.Tensor]()
        for _ in range(self.config.updates_per_step):
            batches.append(self.replay.sample(self.config.batch_size, self._random))
            begun.append(self.learner.begin(batches[-1], beta))
        losses = [Losses.of(figures) for figures in begun]
        return batches, losses, time.perf_counter() - began_s

    def _refresh_actor(self) -> None:
        """Copy the learned weights to the actor that acts."""
        if self._acting is not self.learner.actor:
            self.in_thread(self._acting.load_state_dict, self.learner.actor.state_dict())

    def _forget_losses(self) -> None:
        self._losses: list[tuple[float, ...]] = []
        self._learning_s = self._waiting_s = 0.0


class UnhurriedLearning(LearningThread):
    """A learner beside a person: ``act``, ``begin`` and ``finish`` never wait for an update.

    The policy acts in the loop's thread, with the weights of the last finished update.
    An episode's steps are stored at its end, when it is known whether the person discards it.
    """

    def __init__(self, config: RunConfig, env: Any) -> None:
        super().__init__(config, env)
        self._acting = copy.deepcopy(self._acting)  # Updates must not change it while it acts.
        self._kept: list[Transition] = []
        # Lowers that thread's priority alone.
        self.in_thread(lambda: os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS))

    def act(self, observation: Observation) -> Action:
        return self._acting.act(observation[None])[0]

    def add(self, transition: Transition) -> None:
        self._kept.append(transition)

    def begin(self, beta: float) -> None:
        """Start an update, unless the last one is still running."""
        if self._collect():
            super().begin(beta)

    def finish(self) -> float:
        return 0.0

    def end_episode(self, progress: float, keep: bool = True) -> dict[str, Any]:
        self.settle()
        return super().end_episode(progress, keep)

    def release(self, keep: bool = True) -> None:
        self.settle()
        kept, self._kept = self._kept, []
        for transition in kept if keep else ():
            super().add(transition)
        super().release()

    def state_dict(self) -> dict[str, Any]:
        self.settle()
        return super().state_dict()

    def _refresh_actor(self) -> None:
        # Here: the thread's low priority could make the loop wait.
        self._acting.load_state_dict(self.learner.actor.state_dict())

    def settle(self) -> None:
        # Short waits: a signal that another thread received does not wake the main thread.
        while not self._collect():
            time.sleep(0.002)

    def _collect(self) -> bool:
        """Collect a finished update; return False while one is running."""
        if self._begun is not None:
            if not self._begun.done():
                return False
            super().finish()
        return True
