"""A learner that nobody waits for: the person's clock goes on whatever an update takes.

The policy acts in the loop's thread, from a copy of the actor as of the last finished update. The
next update is begun in the first control period after the last one's end. Steps are stored between
episodes (``episode.py``), when no update is under way.

A run with a person is not repeatable anyway; all others learn as before.
"""

from __future__ import annotations

import copy
import os
import sys
import threading
import time
from typing import Any

import torch

from trainer.learner.td3 import TD3Learner
from trainer.training.learning import Action, EpisodeLearning, LearningThread, Observation

NICENESS = 10
"""Of the updates' thread, and of those that torch starts from it: the person's loop goes first."""
LOOK_S = 0.002
"""How often it is asked whether an update is done, where that must be waited for."""


class UnhurriedLearning:
    """``Learning`` whose ``act``, ``begin`` and ``finish`` never wait for an update.

    Args:
        inner: where it learns.
    """

    def __init__(self, inner: LearningThread) -> None:
        self._inner = inner
        self._actor = copy.deepcopy(inner.learner.actor).eval()
        inner.in_thread(_step_aside)

    @property
    def added(self) -> int:
        """Transitions stored since the run began."""
        return self._inner.added

    @property
    def learner(self) -> TD3Learner:
        """The networks, as of the last finished update: waits for one that is under way."""
        self.settle()
        return self._inner.learner

    @property
    def idle(self) -> bool:
        """Whether no update is under way."""
        return not self._inner.updating

    @torch.no_grad()
    def act(self, observation: Observation) -> Action:
        """The action of the actor's copy, float32 [action size]."""
        return self._actor(torch.from_numpy(observation)[None])[0].numpy()

    def act_together(self, observations: Observation, averaged: bool) -> Action:
        """For validation between sittings: waits for the update, as ``Learning.act_together``."""
        self.settle()
        return self._inner.act_together(observations, averaged)

    def start_episode(self, observation: Observation) -> None:
        """Take an episode's first observation. Waits for the update."""
        self.settle()
        self._inner.start_episode(observation)

    def add(self, *transition: Any, **guidance: Any) -> None:
        """Store a transition; arguments as ``Store.add``. Waits for the update."""
        self.settle()
        self._inner.add(*transition, **guidance)

    def begin(self, beta: float) -> None:
        """Start an update on what is stored, unless the last one is still under way."""
        if self._tidy():
            self._inner.begin(beta)

    def finish(self) -> float:
        """Nothing is waited for: 0 seconds."""
        return 0.0

    def end_episode(self) -> EpisodeLearning:
        """What was learned since the last call; learning rates decay. Waits for the update."""
        self.settle()
        return self._inner.end_episode()

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on. Waits for the update."""
        self.settle()
        return self._inner.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave."""
        self.settle()
        self._inner.load_state_dict(state)
        self._copy_actor()

    def close(self) -> None:
        """Stop the updates' thread."""
        self._inner.close()

    def settle(self) -> None:
        """Wait for the update that is under way."""
        # In short waits: a signal that another thread took does not wake the main thread.
        while not self._tidy():
            time.sleep(LOOK_S)

    def _tidy(self) -> bool:
        """Finish an update that is done; False where one is not."""
        if self._inner.updating:
            return False
        if self._inner.begun:
            self._inner.finish()
            self._copy_actor()
        return True

    def _copy_actor(self) -> None:
        self._actor.load_state_dict(self._inner.learner.actor.state_dict())


def _step_aside() -> None:
    """Lower the priority of the thread that calls this, where threads have one (Linux)."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
