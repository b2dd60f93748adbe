"""Replay and learner beside the environment: one update while one step is driven.

The order is fixed, so that a run depends on its seed alone: in each control period the policy acts,
an update on what was stored before is begun, the environment takes its step, the update is
finished, and only then the step is stored.
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space

from edge_runtime.util import UserError
from trainer.human.guide import Action, Observation
from trainer.learner.config import Algorithm, LearnerConfig
from trainer.learner.networks import FRAMES_SPACE
from trainer.learner.replay import FRAMES_LAYOUT, Batch, ReplayBuffer, ReplayLayout
from trainer.learner.td3 import Losses, TD3Learner, charges_overruled
from trainer.util import Purpose, random_stream

LOSSES = Losses._fields[:4]  # What is averaged over an episode


class LearningThread:
    """A learner with its replay buffer; the updates run in a thread of their own.

    The policy acts in that thread, too, in validation as well: another would bring a second pool
    of OpenMP threads, and the two would fight for the same cores. Only a human model acts in the
    loop's thread, beside the update: a batch of one needs no other thread.

    The networks are on ``device``, the replay buffer is in the processor's memory.

    Raises UserError: there is no memory for the replay buffer.
    """

    def __init__(
        self,
        config: LearnerConfig,
        algorithm: Algorithm,
        seed: int,
        action_size: int,
        device: str = "cpu",
        space: Space[Any] = FRAMES_SPACE,
        layout: ReplayLayout = FRAMES_LAYOUT,
    ) -> None:
        self.config = config
        self.learner = TD3Learner(config, algorithm, seed, action_size, device, space)
        try:
            self.replay = ReplayBuffer(
                config.replay_capacity,
                action_size,
                config.alpha,
                algorithm.separate_buffers,
                config.return_steps,
                config.gamma,
                config.intervention_penalty if charges_overruled(config, algorithm) else None,
                layout,
                algorithm.human_share,
                bool(algorithm.foresight),
            )
        except MemoryError:
            raise UserError(
                f"there is no memory for a replay buffer of {config.replay_capacity} "
                "transitions: --set replay_capacity=N, a smaller one"
            ) from None
        self._random = random_stream(seed, Purpose.REPLAY)
        # Adam's mean of a gradient that has ended stays denormal for ever, and a processor takes
        # many times as long for those: 3 ms a step instead of 1. To a weight they add nothing.
        # First of all in this thread, so that the kernel's OpenMP threads inherit it.
        self._thread = ThreadPoolExecutor(1, "learner", torch.set_flush_denormal, (True,))
        self._updates = algorithm.updates_per_step
        self._begun: tuple[list[Batch], Future[tuple[list[Losses], float]]] | None = None
        self._forget_episode()

    @property
    def added(self) -> int:
        """Transitions stored since the run began."""
        return self.replay.added

    @property
    def updating(self) -> bool:
        """Whether ``finish`` would wait now."""
        return self._begun is not None and not self._begun[1].done()

    def act(self, observation: Observation) -> Action:
        """The actor's action, float32 [action size]; not while updating."""
        return self.in_thread(self.learner.actor.act, observation[None])[0]

    def doubt(self, observation: Observation, action: Action) -> float:
        """How much the critics differ about an action; not while updating."""
        return self.in_thread(self.learner.doubt, observation, action)

    def in_thread(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """What ``work(*arguments)`` returns in the updates' thread, after the update under way."""
        return self._thread.submit(work, *arguments).result()

    def start_episode(self, observation: Observation) -> None:
        """Take an episode's first observation."""
        self.replay.start_episode(observation)

    def add(self, *transition: Any, **guidance: Any) -> None:
        """Store a transition; arguments as ``ReplayBuffer.add``."""
        self.replay.add(*transition, **guidance)

    def begin(self, beta: float) -> None:
        """Start an update, or several, on what is stored; ``beta`` is eq. 15's exponent."""
        size = self.config.batch_size
        batches = [self.replay.sample(size, self._random) for _ in range(self._updates)]
        self._begun = batches, self._thread.submit(self._update, batches, beta)

    def finish(self) -> float:
        """Wait until the update that was begun is done, if one was; the seconds waited.

        What the update raised comes out here; FloatingPointError where learning has diverged.
        """
        if self._begun is None:
            return 0.0
        began_s = time.perf_counter()
        (batches, update), self._begun = self._begun, None
        done, learning_s = update.result()
        if not all(np.isfinite(losses.priorities).all() for losses in done):
            raise FloatingPointError("its losses are no longer finite")
        waited_s = time.perf_counter() - began_s
        self._waiting_s += waited_s
        self._learning_s += learning_s
        for batch, losses in zip(batches, done, strict=True):
            self._losses.append(losses[:4])
            self.replay.update_priorities(batch.indices, losses.priorities)
        return waited_s

    def end_episode(self, progress: float) -> dict[str, Any]:
        """What was learned since the last call, as fields of `EpisodeMetrics`; rates fall.

        Losses are nan where there was no update.
        """
        self.learner.decay_learning_rates(progress)
        means = np.mean(self._losses, axis=0) if self._losses else [math.nan] * len(LOSSES)
        policy_priority, human_priority = self.replay.mean_priorities()
        learned = {
            **dict(zip(LOSSES, map(float, means), strict=True)),
            "policy_priority": policy_priority,
            "human_priority": human_priority,
            "learning_s": self._learning_s,
            "waiting_s": self._waiting_s,
        }
        self._forget_episode()
        return learned

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on."""
        return {
            "learner": self.learner.state_dict(),
            "replay": {
                name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
                for name, value in self.replay.state_dict().items()
            },
            "drawing": self._random.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave."""
        self.learner.load_state_dict(state["learner"])
        self.replay.load_state_dict(state["replay"])
        self._random.bit_generator.state = state["drawing"]

    def close(self) -> None:
        """Stop the thread."""
        self._thread.shutdown()

    def _update(self, batches: list[Batch], beta: float) -> tuple[list[Losses], float]:
        began_s = time.perf_counter()
        losses = [self.learner.update(batch, beta) for batch in batches]
        return losses, time.perf_counter() - began_s

    def _forget_episode(self) -> None:
        self._losses: list[tuple[float, ...]] = []
        self._learning_s = self._waiting_s = 0.0
