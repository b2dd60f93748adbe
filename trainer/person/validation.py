"""Validation beside a person: in a process of its own, while the person drives on.

A thread would share Python's lock with the person's loop: on a busy machine every second control
period began late.
"""

import copy
import math
import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray

from bridge.outcomes import GOAL
from bridge.report import EpisodeResult
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.util import counted
from trainer.drivers import TogetherDriver
from trainer.learner.networks import Actor
from trainer.person.session import Sitting
from trainer.training.config import RunConfig
from trainer.training.learning import NICENESS, LearningThread
from trainer.training.metrics import EpisodeMetrics
from trainer.training.validation import Trials, Validation
from trainer.util import Purpose, die_with_parent, episode_seed, interrupts_blocked


class Candidate(NamedTuple):
    actor: Actor
    episode: int  # So many had been driven
    human_s: float  # So much had the person given
    seeds: dict[int, int]
    """Episode -> its seed, of those that the policy is to try, beside the validation's own."""


class PersonValidation(Validation):
    """Validates behind the scenes, and once more at a sitting's end, when the page is closed."""

    def __init__(
        self, config: RunConfig, run_dir: Path, learning: LearningThread, sitting: Sitting
    ) -> None:
        super().__init__(config, run_dir, learning, sitting.env)
        self.sitting, self._behind = sitting, BehindTheScenes(config)

    def after(self, metrics: EpisodeMetrics, episode: int, due: bool, at_end: bool) -> None:
        """Tell the person what was learned, and validate; a person does not wait for it."""
        sitting = self.sitting
        human_s = sum(each.human_s for each in sitting.driven)
        takeovers = sum(each.takeovers for each in sitting.driven)
        sitting.progress = (
            f"{counted(self.learning.added, 'step')} stored, "
            f"{round(human_s / sitting.env.control_period_s)} yours in "
            f"{counted(takeovers, 'intervention')} of this sitting; "
            f"{self.learned(metrics.critic_loss)}, return {metrics.episode_return:.1f}"
        )
        if not at_end:
            self._beside(metrics, episode, due)
            return
        runs, every = self.config.evaluation_runs, self.config.evaluate_every_steps
        try:
            sitting.close()
            self.close()
            if every:
                said = f"validating on {runs} episodes; all is saved, ^C leaves it out"
                print(said, file=sys.stderr, flush=True)
            with sigterm_as_interrupt():  # SIGHUP, too: this episode's row is to be written.
                super().after(metrics, episode, bool(every), at_end)
        except KeyboardInterrupt:
            with suppress(OSError):  # The terminal may be gone.
                print("validation left out", file=sys.stderr)

    def learned(self, critic_loss: float) -> str:
        """Return what the learner did in an episode: nothing before its warm-up is over."""
        added, warmup = self.learning.added, self.config.learner.warmup_steps
        if added < warmup:
            return f"not learning yet ({added} of {warmup} steps)"
        return "critic loss –" if math.isnan(critic_loss) else f"critic loss {critic_loss:.3f}"

    def close(self) -> None:
        """Break off what is under way beside the person."""
        self._behind.close()

    def _beside(self, metrics: EpisodeMetrics, episode: int, due: bool) -> None:
        """Take the validation that is done, into this episode's row, and begin one that is due."""
        coach, found = self.sitting.coach, self._behind.take()
        if found is not None:
            candidate, drives = found
            runs = self.config.evaluation_runs
            self.take(drives[:runs], candidate.actor, metrics, candidate.episode)
            goals = [drive.outcome == GOAL for drive in drives[runs:]]
            mastered = dict(zip(candidate.seeds, goals, strict=True))
            coach.take(candidate.human_s, metrics.validation_success, mastered)
        if due and metrics.updates and not self._behind.busy:
            actor = copy.deepcopy(getattr(self.learning.learner, self.config.kept_actor)).cpu()
            seeds = {
                number: episode_seed(self.config.seed, Purpose.TRAINING, number)
                for number in coach.to_check()
            }
            given_s = self.sitting.cost["human_s"]
            self._behind.begin(Candidate(actor, episode, given_s, seeds))
        coach.checking = self._behind.busy


class BehindTheScenes:
    """The parent's side of the validation process; only ``close`` waits for it, and kills it."""

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._process = ProcessPoolExecutor(1, get_context("spawn"), _start_validating)
        self._begun: tuple[Candidate, Future[list[EpisodeResult]]] | None = None

    @property
    def busy(self) -> bool:
        """Whether a validation is under way."""
        return self._begun is not None and not self._begun[1].done()

    def begin(self, candidate: Candidate) -> None:
        # Not as tensors: torch would share their memory with the process.
        weights = {name: value.numpy() for name, value in candidate.actor.state_dict().items()}
        seeds = list(candidate.seeds.values())
        try:
            with interrupts_blocked(), _without_script():
                answer = self._process.submit(_validate, self._config, weights, seeds)
            self._begun = candidate, answer
        except BrokenExecutor:
            self._begun = None  # It was killed; `take` has said so.

    def take(self) -> tuple[Candidate, list[EpisodeResult]] | None:
        """Return what the validation that was begun has come to; None where there is nothing new,
        or it failed: then it says why on stderr.
        """
        if self._begun is None or self.busy:
            return None
        (candidate, answer), self._begun = self._begun, None
        if error := answer.exception():
            print(f"no validation beside the drive: {error}", file=sys.stderr)
            return None
        return candidate, answer.result()

    def close(self) -> None:
        self.kill()
        self._process.shutdown(cancel_futures=True)

    def kill(self) -> None:
        """End the process at once, whatever it does."""
        for process in list((self._process._processes or {}).values()):
            process.kill()


@contextmanager
def _without_script() -> Iterator[None]:
    """A process that is spawned meanwhile does not run the script again that trains here."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _start_validating() -> None:
    """Begin the process: aside of the loop, and to end with it."""
    threading.Thread(target=die_with_parent, daemon=True).start()
    os.nice(NICENESS)
    torch.set_num_threads(1)


_trials = cache(Trials)  # Of the one config


def _validate(
    config: RunConfig, weights: dict[str, NDArray[Any]], seeds: list[int]
) -> list[EpisodeResult]:
    """Drive what `BehindTheScenes.begin` asks for, in its process."""
    trials = _trials(config)
    env = trials.envs[0]
    actor = Actor(env.action_space.shape[0], config.learner.frames, env.observation_space)
    actor.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return trials.drive(TogetherDriver(actor.eval().act), seeds)
