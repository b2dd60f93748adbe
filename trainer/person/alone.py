"""Validates copies of the policy in a process of its own, while the person drives on.

A thread would share Python's lock with the person's loop: on a busy machine every second control
period began late.
"""

import os
import sys
import threading
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray

from bridge.report import EpisodeResult
from trainer.drivers import TogetherDriver
from trainer.learner.networks import Actor
from trainer.training.config import RunConfig
from trainer.training.metrics import Trials
from trainer.util import die_with_parent, interrupts_blocked

NICENESS = 10  # The person's loop goes first


class Check(NamedTuple):
    """A policy to be validated."""

    actor: Actor
    episode: int  # So many had been driven
    human_s: float  # So much had the person given
    seeds: dict[int, int]
    """Episode -> its seed, of those that the policy is to try, beside the validation's own."""


class BehindTheScenes:
    """The parent's end: nothing that it does waits for the process."""

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._process = ProcessPoolExecutor(1, get_context("spawn"), _start)
        self._begun: tuple[Check, Future[list[EpisodeResult]]] | None = None

    @property
    def busy(self) -> bool:
        """Whether a validation is under way."""
        return self._begun is not None and not self._begun[1].done()

    def begin(self, check: Check) -> None:
        """Start to validate."""
        # Not as tensors: torch would share their memory with the process.
        weights = {name: value.numpy() for name, value in check.actor.state_dict().items()}
        seeds = list(check.seeds.values())
        try:
            with interrupts_blocked():
                self._begun = check, self._process.submit(_drive, self._config, weights, seeds)
        except BrokenExecutor:
            self._begun = None  # It was killed; `take` has said so.

    def take(self) -> tuple[Check, list[EpisodeResult]] | None:
        """What the validation that was begun has come to; None where there is nothing new, or it
        failed: then it says why on stderr.
        """
        if self._begun is None or self.busy:
            return None
        (check, answer), self._begun = self._begun, None
        if error := answer.exception():
            print(f"no validation beside the drive: {error}", file=sys.stderr)
            return None
        return check, answer.result()

    def close(self) -> None:
        """Break off what is under way."""
        self.kill()
        self._process.shutdown(cancel_futures=True)

    def kill(self) -> None:
        """End the process at once, whatever it does."""
        for process in list((self._process._processes or {}).values()):
            process.kill()


def _start() -> None:
    threading.Thread(target=die_with_parent, daemon=True).start()
    os.nice(NICENESS)
    torch.set_num_threads(1)


_trials = cache(Trials)  # Of the one config


def _drive(
    config: RunConfig, weights: dict[str, NDArray[Any]], seeds: list[int]
) -> list[EpisodeResult]:
    """The process's end."""
    trials = _trials(config)
    env = trials.envs[0]
    actor = Actor(env.action_space.shape[0], config.learner.frames, env.observation_space)
    actor.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return trials.drive(TogetherDriver(actor.eval().act), seeds)
