"""A training guided by a person: set it up, and recover the steps after a kill."""

import argparse
import copy
import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from numpy.typing import NDArray

from bridge.report import EpisodeResult
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import make_directory
from edge_runtime.util import UserError
from trainer.evaluation import TogetherDriver
from trainer.human.guide import BY_PERSON, Intervention
from trainer.learner.config import find_algorithm
from trainer.learner.networks import Actor
from trainer.person import vector, web
from trainer.person.recording import DIRECTORY, Recorder, read_episodes, steps_since
from trainer.person.session import PacedEnvironment, Sitting
from trainer.training.config import DEFAULTS, RunConfig
from trainer.training.learning import NICENESS, LearningThread, UnhurriedLearning
from trainer.training.metrics import EpisodeMetrics, read_metrics
from trainer.training.run import Score, TrainingRun, Trials, Validation
from trainer.util import begin_process

SCRIPTED = (
    "guided_share", "guided_until_episode", "poor_guidance_share", "late_to_s", "missed_share",
)  # fmt: skip
"""Settings of a scripted human."""


@contextmanager
def training_with_person(
    arguments: argparse.Namespace, config: RunConfig, run_dir: Path, env: Any, resume: bool
) -> Iterator[tuple[TrainingRun, Callable[[], bool]]]:
    """Open a run guided by a person; yield it, and a function that ends the sitting.

    A resumed run first stores the steps recorded after its checkpoint.
    """
    check_settings(config)
    with ExitStack() as stack:
        person = stack.enter_context(closing(web.open_cockpit(arguments, env)))
        make_directory(run_dir)
        sitting = Sitting(person, env, Recorder(run_dir / DIRECTORY), arguments.speed)
        stack.enter_context(closing(sitting))
        learning = UnhurriedLearning(config, env)
        validation = PersonValidation(config, run_dir, learning, sitting)
        stack.enter_context(closing(validation))
        training = TrainingRun(config, run_dir, resume, env, sitting, learning, validation)
        training.vehicle = PacedEnvironment(training.vehicle, sitting)
        training.recorders.append(sitting.record)
        if resume:
            _recover(training, sitting)
        else:
            training.save()  # So that a run killed in its first episode can be resumed.
        sitting.episode = training.episode
        yield training, sitting.quit
        print(sitting.summary(), file=sys.stderr)


def _recover(training: TrainingRun, sitting: Sitting) -> None:
    """Store the steps recorded after the checkpoint as if they had just been driven."""
    steps = human = 0
    for episode in read_episodes(steps_since(training.run_dir / DIRECTORY, sitting.saved_at)):
        for step in episode:
            action = vector(step.action)
            by_person = Intervention(action, BY_PERSON, step.first) if step.human else None
            training.learning.add(step.transition(training.penalises(by_person)))
        training.learning.release()
        steps += len(episode)
        human += sum(step.human for step in episode)
    if steps:
        yours = f"{human} of them yours"
        print(f"{steps} recorded steps after the checkpoint, {yours}, are back", file=sys.stderr)
    # Episodes that ended after the checkpoint count, since the person's time was spent.
    if ended := read_metrics(training.run_dir)[training.episode :]:
        training.episode += len(ended)
        training.steps = int(ended[-1]["total_steps"])


def check_settings(config: RunConfig) -> None:
    """Raise UserError for an algorithm or a setting that does not go with a person."""
    row = find_algorithm(config.algorithm)
    if not row.guided or row.asks:
        raise UserError(f"{config.algorithm} takes no guidance of a person")
    for name in SCRIPTED:
        if getattr(config, name) != (default := getattr(DEFAULTS, name)):
            raise UserError(f"{name} is of a scripted human; with a person it must be {default}")


class PersonValidation(Validation):
    """Validates in a process of its own, and once more after the sitting, the page closed."""

    def __init__(
        self, config: RunConfig, run_dir: Path, learning: LearningThread, sitting: Sitting
    ) -> None:
        super().__init__(config, run_dir, learning, sitting.env)
        self.sitting, self._alone = sitting, ""  # Success of the policy alone, in words
        self._process = ProcessPoolExecutor(1, get_context("spawn"), begin_process, (NICENESS,))
        self._begun: tuple[Actor, int, Future[list[EpisodeResult]]] | None = None
        """The actor under validation, the episodes before it, and its future results."""

    def after(self, metrics: EpisodeMetrics, episode: int, due: bool, at_end: bool) -> None:
        """Show the person the progress, and validate without making the person wait."""
        if not at_end:
            self._beside(metrics, episode, due)
            added, warmup = self.learning.replay.added, self.config.learner.warmup_steps
            learned = "" if metrics.updates else f"not learning yet ({added} of {warmup} steps), "
            self.sitting.progress = f"{learned}return {metrics.episode_return:.1f}{self._alone}"
            return
        every = self.config.evaluate_every_steps
        try:
            self.sitting.close()
            self.close()
            if every:
                print("validating; all is saved, ^C leaves it out", file=sys.stderr, flush=True)
            with sigterm_as_interrupt():  # Also SIGHUP: this episode's row must be written.
                super().after(metrics, episode, bool(every), at_end)
        except KeyboardInterrupt:
            with suppress(OSError):  # The terminal may be gone.
                print("validation left out", file=sys.stderr)

    def close(self) -> None:
        for process in list((self._process._processes or {}).values()):
            process.kill()  # The person need not wait for it.
        self._process.shutdown(cancel_futures=True)

    def _beside(self, metrics: EpisodeMetrics, episode: int, due: bool) -> None:
        """Enter a finished validation into this episode's row, and start one that is due."""
        if self._begun is not None and self._begun[2].done():
            (actor, then, drives), self._begun = self._begun, None
            if error := drives.exception():
                print(f"no validation beside the drive: {error}", file=sys.stderr)
            else:
                self.take(drives.result(), actor, metrics, then)
                result = f"has a return of {metrics.validation_reward:.1f}"
                if not math.isnan(metrics.validation_success):
                    result = f"succeeds in {metrics.validation_success:.0%}"
                self._alone = f", the policy alone {result}"
        if due and metrics.updates and self._begun is None:
            actor = copy.deepcopy(getattr(self.learning.learner, self.config.kept_actor)).cpu()
            # Not as tensors: torch would share their memory with the process.
            weights = {name: value.numpy() for name, value in actor.state_dict().items()}
            # BrokenExecutor: the process was killed, which stderr has reported.
            with suppress(BrokenExecutor), _without_script():
                answer = self._process.submit(_validate, self.config, weights, self.best)
                self._begun = actor, episode, answer


@contextmanager
def _without_script() -> Iterator[None]:
    """Keep a process spawned meanwhile from running the training script again."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


_trials = cache(Trials)  # Made once: all calls have the same config


def _validate(
    config: RunConfig, weights: dict[str, NDArray[Any]], best: Score
) -> list[EpisodeResult]:
    """Drive the validation of an actor, in a process beside the person."""
    torch.set_num_threads(1)
    trials = _trials(config)
    env = trials.envs[0]
    actor = Actor(env.action_space.shape[0], config.learner.frames, env.observation_space)
    actor.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return trials.drive(TogetherDriver(actor.eval().act), best)
