"""Replay and learner on an accelerator: the processor waits for the action and for nothing else.

An update is one CUDA graph: it draws from the replay buffer in the accelerator's memory, learns,
and writes the new priorities. It runs while the environment takes its step; the next action queues
behind it, and is the one thing that is waited for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from trainer import seeds
from trainer.files import as_arrays, as_tensors
from trainer.learner.algorithms import Algorithm
from trainer.learner.captured import captured, changed_by_learning
from trainer.learner.config import LearnerConfig
from trainer.learner.device_replay import DeviceReplay
from trainer.learner.replay import FRAME_SHAPE
from trainer.learner.staging import Staging
from trainer.learner.td3 import TD3Learner
from trainer.training.learning import NO_LOSSES, Action, EpisodeLearning, Observation
from trainer.training.update_clock import UpdateClock


class AcceleratorLearning:
    """``Learning`` on CUDA; on another device the same without graphs.

    Args:
        config: hyper-parameters.
        algorithm: the row of the table of switches.
        seed: of weights, noise and draws.
        action_size: length of an action.
        device: where replay and learner are.
    """

    def __init__(
        self,
        config: LearnerConfig,
        algorithm: Algorithm,
        seed: int,
        action_size: int,
        device: str = "cuda",
    ) -> None:
        self.config, self.device = config, torch.device(device)
        if self.device.type == "cuda":
            _calculate_exactly()
        self.learner = TD3Learner(config, algorithm, seed, action_size, device)
        self.replay = DeviceReplay(
            config.replay_capacity, action_size, config.alpha, device, algorithm.separate_buffers
        )
        # Not the run's seed itself: the smoothing noise comes from that.
        drawing_seed = int(seeds.stream(seed, seeds.REPLAY).integers(2**63))
        self._drawing = torch.Generator(self.device).manual_seed(drawing_seed)
        self._seen = Staging(np.dtype([("frames", np.uint8, (1, 2, *FRAME_SHAPE))]), self.device)
        self._action = torch.zeros(action_size, device=self.device)
        self._read_action = torch.zeros(action_size, pin_memory=self.device.type == "cuda")
        self._beta = torch.zeros((), device=self.device)
        self._loss_sums = torch.zeros(4, device=self.device, dtype=torch.float64)
        self._graphs: dict[str, Callable[[], None]] = {}
        self._clock = UpdateClock(self.device)
        self._updates = 0
        self._waiting_s = 0.0
        self.replay.store = self._store

    @property
    def added(self) -> int:
        """Transitions stored since the run began."""
        return self.replay.added

    def act(self, observation: Observation, averaged: bool = False) -> Action:
        """The actor's action or the target actor's, float32 [action size]; waits for the update."""
        self._seen.row()["frames"] = observation
        self._seen.send()
        if averaged:
            self._run_graph("act_averaged", self._choose_averaged_action)
        else:
            self._run_graph("act", self._choose_action)
        self._read_action.copy_(self._action, non_blocking=True)
        began_s = time.perf_counter()
        if self.device.type == "cuda":
            torch.cuda.current_stream().synchronize()
        self._waiting_s += time.perf_counter() - began_s
        return self._read_action.numpy().copy()

    def start_episode(self, observation: Observation) -> None:
        """Take an episode's first observation."""
        # Validation between two episodes waits for its actions, too.
        self._waiting_s = 0.0
        self.replay.start_episode(observation)

    def add(
        self, action: Action, reward: float, observation: Observation, terminal: bool, human: bool
    ) -> None:
        """Store a transition that led to ``observation``, after the update that was begun."""
        self.replay.add(action, reward, observation, terminal, human)

    def begin(self, beta: float) -> None:
        """Start an update on what is stored; ``beta`` is eq. 15's exponent."""
        self._beta.fill_(beta)
        self._updates += 1
        with_policy = self.learner.count_update()
        update = self._update_all if with_policy else self._update_critics
        graph = self._graph("update" if with_policy else "update critics", update, learning=True)
        with self._clock.timed():
            graph()

    def finish(self) -> float:
        """Nothing to wait for: what comes next on the device comes after the update."""
        return 0.0

    def end_episode(self) -> EpisodeLearning:
        """What was learned since the last call, read back at once; learning rates decay."""
        self.learner.decay_learning_rates()
        found = torch.cat([self._loss_sums, self.replay.priority_means()]).cpu().numpy()
        self._loss_sums.zero_()
        if np.isinf(found).any() or np.isnan(found[:4]).any():
            raise FloatingPointError("its losses are no longer finite")
        mean_losses = found[:4] / self._updates if self._updates else NO_LOSSES
        learned = EpisodeLearning(
            self._clock.take_total_s(),
            self._waiting_s,
            *map(float, [*mean_losses, *found[4:]]),
        )
        self._updates, self._waiting_s = 0, 0.0
        return learned

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on."""
        return {
            "learner": self.learner.state_dict(),
            "replay": as_tensors(self.replay.state_dict()),
            "drawing": self._drawing.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave."""
        # Optimisers change addresses when they load.
        self._graphs.clear()
        self.learner.load_state_dict(state["learner"])
        self.replay.load_state_dict(as_arrays(state["replay"]))
        self._drawing.set_state(state["drawing"])

    def close(self) -> None:
        """Let go of the graphs and their memory."""
        self._graphs.clear()

    @torch.no_grad()
    def _choose_action(self) -> None:
        self._action.copy_(self.learner.actor(self._seen.fields["frames"])[0])

    def _choose_averaged_action(self) -> None:
        self._action.copy_(self.learner.target_actor(self._seen.fields["frames"])[0])

    def _store(self) -> None:
        self._run_graph("store", self.replay.store_record)

    def _update_all(self) -> None:
        self._update(with_policy=True)

    def _update_critics(self) -> None:
        self._update(with_policy=False)

    def _update(self, with_policy: bool) -> None:
        indices, batch = self.replay.draw(self.config.batch_size, self._drawing)
        outcome = self.learner.change(batch, self._beta, with_policy)
        self.replay.set_priorities(indices, outcome.priorities)
        self._loss_sums += outcome.losses

    def _run_graph(self, name: str, function: Callable[[], None]) -> None:
        self._graph(name, function)()

    def _graph(
        self, name: str, function: Callable[[], None], learning: bool = False
    ) -> Callable[[], None]:
        """The function, captured at its first use; only learning is not harmless to repeat."""
        if name not in self._graphs:
            changed, generators = [], []
            if learning and self.device.type == "cuda":
                changed = [*changed_by_learning(self.learner), self.replay.priorities]
                changed.append(self._loss_sums)
                generators = [self.learner.noise, self._drawing]
            self._graphs[name] = captured(function, self.device, changed, generators)
        return self._graphs[name]


def _calculate_exactly() -> None:
    """Float32 products in full, and the same every time: a resumed run must equal one unbroken."""
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.deterministic = True
