"""A training that a person guides: paced, recorded, and never waiting for an update.

The policy acts in the loop's thread, from a copy of the actor as of the last finished update. The
next update begins in the first control period after the last one's end. An episode's steps are
stored at its end, when it is known whether the person discards it. A run with a person is not
repeatable anyway.

Copies of the policy are validated in a process of its own, while the person drives on. A thread
would share Python's lock with the person's loop: on a busy machine every second control period
began late.
"""

from __future__ import annotations

import argparse
import copy
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import closing, contextmanager, suppress
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray

from bridge.outcomes import DISCARDED, GOAL
from bridge.report import EpisodeResult
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import make_directory
from edge_runtime.util import UserError, counted
from trainer.drivers import TogetherDriver
from trainer.human.guide import Guide, Intervention
from trainer.learner.config import find_algorithm
from trainer.learner.networks import Actor
from trainer.person.coach import Coach, typical_curve
from trainer.person.interface import Person, amount, open_person, vector
from trainer.person.recording import DIRECTORY, Recorder, steps_since, store_again
from trainer.person.session import Sitting, SittingOver
from trainer.training.config import RunConfig
from trainer.training.delayed import ticks_late
from trainer.training.learning import Action, LearningThread, Observation
from trainer.training.metrics import EpisodeMetrics, Trials, read_metrics, spent
from trainer.training.run import TrainingRun, divergence_said
from trainer.util import Purpose, die_with_parent, episode_seed, interrupts_blocked

NICENESS = 10
"""Of the validation process, and of the update thread with torch's own: the person's loop goes
first."""
LOOK_S = 0.002  # Between two looks whether an update is done, where it must be waited for
PRETENDED = ("poor_guidance_share", "late_to_s", "missed_share")
"""What makes a scripted human imperfect."""


@contextmanager
def training_with_person(
    arguments: argparse.Namespace, config: RunConfig, run_dir: Path
) -> Iterator[PersonRun]:
    """A run with a person in it; everything is kept, whatever ends it."""
    check_settings(config)
    with closing(open_person(arguments)) as person:
        make_directory(run_dir)
        training = PersonRun(config, run_dir, person, arguments.resume, arguments.speed)
        steps, human = training.recovered
        if steps:
            back = f"{steps} recorded steps after the checkpoint, {human} of them yours, are back"
            print(back, file=sys.stderr)
        yield training
        print(training.sitting.summary(), file=sys.stderr)


class UnhurriedLearning(LearningThread):
    """``LearningThread`` whose ``act``, ``begin`` and ``finish`` never wait for an update.

    What is stored is kept back until ``release``: only at an episode's end is it known whether the
    person discards it.
    """

    def __init__(self, *settings: Any) -> None:
        super().__init__(*settings)
        self._actor = copy.deepcopy(self.learner.actor).eval()
        self._kept: list[Callable[[], None]] = []
        self.in_thread(_step_aside)

    def act(self, observation: Observation) -> Action:
        """The action of the actor's copy, float32 [action size]."""
        return self._actor.act(observation[None])[0]

    def begin(self, beta: float) -> None:
        """Start an update on what is stored, unless the last one is still under way."""
        if self._tidy():
            super().begin(beta)

    def finish(self) -> float:
        """Nothing is waited for: 0 seconds."""
        return 0.0

    def start_episode(self, observation: Observation) -> None:
        """As a ``LearningThread``, at the release."""
        self._kept.append(partial(super().start_episode, observation))

    def add(self, *transition: Any, **guidance: Any) -> None:
        """As a ``LearningThread``, at the release."""
        self._kept.append(partial(super().add, *transition, **guidance))

    def release(self, discarded: bool) -> None:
        """Store what was taken since the last call, or forget it."""
        kept, self._kept = self._kept, []
        if not discarded:
            self.settle()
            for store in kept:
                store()

    def end_episode(self, progress: float) -> dict[str, Any]:
        """As a ``LearningThread``, after the update that is under way."""
        self.settle()
        return super().end_episode(progress)

    def state_dict(self) -> dict[str, Any]:
        """As a ``LearningThread``, after the update that is under way."""
        self.settle()
        return super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave."""
        super().load_state_dict(state)
        self._copy_actor()

    def settle(self) -> None:
        """Wait for the update that is under way."""
        # In short waits: a signal that another thread took does not wake the main thread.
        while not self._tidy():
            time.sleep(LOOK_S)

    def _tidy(self) -> bool:
        """Finish an update that is done; False where one is not."""
        if self.updating:
            return False
        if self._begun is not None:
            super().finish()
            self._copy_actor()
        return True

    def _copy_actor(self) -> None:
        self._actor.load_state_dict(self.learner.actor.state_dict())


class PersonRun(TrainingRun):
    """``TrainingRun`` in a sitting; what an episode has shown is stored at its end.

    The recordings go into ``sittings`` in the run's directory, and a resumed run stores what was
    recorded after its checkpoint. ``person`` is closed with the run; ``speed``: simulated seconds
    in one of the person's.
    """

    learning_kind = UnhurriedLearning
    learning: UnhurriedLearning

    def __init__(
        self, config: RunConfig, run_dir: Path, person: Person, resume: bool, speed: float
    ) -> None:
        self._resumed = resume
        self.recovered = (0, 0)
        """Steps, and the person's among them, that a kill had kept from the checkpoint."""
        super().__init__(config, run_dir, resume)
        recorder = Recorder(run_dir / DIRECTORY)
        self.sitting = Sitting(person, recorder, self.env, speed=speed)
        before = [row for row in read_metrics(run_dir) if int(row["episode"]) < self.episode]
        given = spent(before, self.env.control_period_s)
        given["failures"] = sum(given["failures"].values())
        self.sitting.ended = [row["outcome"] for row in before]
        self.sitting.cost.update({name: given[name] for name in self.sitting.cost})
        coach = Coach(typical_curve(config.scenario, config.algorithm), learning=True)
        coach.recall(before, self.env.control_period_s)
        self.sitting.coach = coach
        self.behind_the_scenes = BehindTheScenes(config)
        self.guide = PersonGuide(self.sitting)
        self.env = self.sitting

    def train(
        self,
        on_episode: Callable[[EpisodeMetrics], None] = lambda metrics: None,
        deadline_s: float = math.inf,
    ) -> None:
        """Train until the person quits, or as ``TrainingRun`` does."""
        try:
            if not self._resumed:
                self.save()  # So that a run killed in its first episode can be resumed.
            super().train(on_episode, deadline_s)
        except SittingOver:
            self.save()
        finally:
            self.behind_the_scenes.close()
            self.sitting.close()

    def quit(self) -> bool:
        """Ask for the end of the sitting. KeyboardInterrupt where it is closed already: that ends
        the last validation, and the episode's row is written.
        """
        if self.sitting.closed:
            raise KeyboardInterrupt
        return self.sitting.quit()

    def advance(self) -> EpisodeMetrics:
        """Train one episode, and rest."""
        self.sitting.episode = self.episode
        metrics = super().advance()
        metrics.outcome = self.sitting.rest(metrics.outcome)
        self.learning.release(discarded=metrics.outcome == DISCARDED)
        metrics.total_steps = self.learning.added
        self.sitting.progress = (
            f"{counted(self.learning.added, 'step')} stored, {self.sitting.human_steps} yours in "
            f"{counted(self.sitting.interventions, 'intervention')} of this sitting; "
            f"{self._learned(metrics.critic_loss)}, return {metrics.episode_return:.1f}"
        )
        return metrics

    def save(self) -> None:
        """Write the checkpoint, which the person sees."""
        self.sitting.show("saving")
        with divergence_said(self.episode):  # The update under way may be the one.
            super().save()

    def _learned(self, critic_loss: float) -> str:
        """What the learner did in an episode: nothing before its warm-up is over."""
        warmup = self.config.learner.warmup_steps
        if self.learning.added < warmup:
            return f"not learning yet ({self.learning.added} of {warmup} steps)"
        return "critic loss –" if math.isnan(critic_loss) else f"critic loss {critic_loss:.3f}"

    def _make_guide(self) -> Guide | None:
        return None  # The sitting is opened when all else is known to work.

    def _must_stop(self, deadline_s: float) -> bool:
        return self.sitting.stop or super()._must_stop(deadline_s)

    def _validate(self, metrics: EpisodeMetrics, at_end: bool) -> None:
        """Behind the scenes, and once more at a sitting's end, when the page is closed: a person
        is not to wait.
        """
        if not at_end:
            self._check_alone(metrics)
            return
        self.save()
        try:
            self.sitting.close()
            self.behind_the_scenes.close()
            if self.config.evaluate_every_steps:
                runs = self.config.evaluation_runs
                said = f"validating on {runs} episodes; all is saved, ^C leaves it out"
                print(said, file=sys.stderr, flush=True)
            with sigterm_as_interrupt():  # SIGHUP, too: this episode's row is to be written.
                super()._validate(metrics, at_end)
        except KeyboardInterrupt:
            with suppress(OSError):  # The terminal may be gone.
                print("validation left out", file=sys.stderr)

    def _check_alone(self, metrics: EpisodeMetrics) -> None:
        """Take the validation that is done, into this episode's row, and begin one that is due."""
        coach, found = self.sitting.coach, self.behind_the_scenes.take()
        if found is not None:
            check, drives = found
            runs = self.config.evaluation_runs
            self.validation.take(drives[:runs], check.actor, metrics, check.episode)
            goals = [drive.outcome == GOAL for drive in drives[runs:]]
            mastered = dict(zip(check.seeds, goals, strict=True))
            coach.take(check.human_s, metrics.validation_success, mastered)
        due = self.config.evaluate_every_steps and super()._due(metrics.steps)
        if due and metrics.updates and not self.behind_the_scenes.busy:
            actor = copy.deepcopy(getattr(self.learning.learner, self.config.kept_actor)).cpu()
            seeds = {
                number: episode_seed(self.config.seed, Purpose.TRAINING, number)
                for number in coach.to_check()
            }
            given_s = self.sitting.cost["human_s"]
            self.behind_the_scenes.begin(Check(actor, self.episode, given_s, seeds))
        coach.checking = self.behind_the_scenes.busy

    def _due(self, last_steps: int) -> bool:
        return True  # A person's run has no other end than a sitting's.

    def _more_state(self) -> dict[str, Any]:
        return {"recorded": [self.sitting.recorder.sitting, self.sitting.recorder.index]}

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        sitting, index = state["recorded"]
        steps = steps_since(self.run_dir / DIRECTORY, (sitting, index))
        self.recovered = store_again(
            self.learning,
            steps,
            self._shape,
            self._penalises,
            ticks_late(self.network, self.env.control_period_s),
        )
        self.learning.release(discarded=False)
        # Episodes that ended after the checkpoint count: the person gave what their rows say.
        rows = read_metrics(self.run_dir)
        ended = [row for row in rows if int(row["episode"]) >= self.episode]
        self.episode += len(ended)
        self.steps += sum(int(row["steps"]) for row in ended)


def check_settings(config: RunConfig) -> None:
    """Refuse what a person cannot be a part of; raises UserError."""
    row = find_algorithm(config.algorithm)
    if not row.guided:
        raise UserError(f"{config.algorithm} takes no guidance: nobody could take over")
    if row.asks:
        raise UserError(f"{config.algorithm} asks a scripted human or its model, and no person yet")
    if config.guided_share != 1 or config.guided_until_episode or config.guided_until_step:
        wanted = "guided_share must be 1, guided_until_episode and guided_until_step 0"
        raise UserError(f"a person watches every episode: {wanted}")
    for name in PRETENDED:
        if getattr(config, name):
            raise UserError(f"a person's actions are not replaced: {name} must be 0")


class PersonGuide:
    """Asks the person each control period, and waits for it to begin."""

    def __init__(self, sitting: Sitting) -> None:
        self._sitting = sitting

    def reset(self) -> None:
        """The sitting begins an episode by itself when the environment is reset."""

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What is carried out instead of ``policy_action``; None lets it pass.

        In a hand-over that is neither the person's action nor the policy's; the replay buffer
        takes it for the person's.
        """
        applied = self._sitting.decide(observation, amount(policy_action))
        action = vector(applied.action)
        return Intervention(action, "person", applied.first) if applied.human else None


def _step_aside() -> None:
    """Lower the priority of the thread that calls this, where threads have one (Linux)."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


class Check(NamedTuple):
    """A policy to be validated."""

    actor: Actor
    episode: int  # So many had been driven
    human_s: float  # So much had the person given
    seeds: dict[int, int]
    """Episode -> its seed, of those that the policy is to try, beside the validation's own."""


class BehindTheScenes:
    """The parent's side of the validation process; only ``close`` waits for it, and kills it."""

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._process = ProcessPoolExecutor(1, get_context("spawn"), _start_validating)
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
            with interrupts_blocked(), _without_script():
                self._begun = check, self._process.submit(_validate, self._config, weights, seeds)
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
    """What the process begins with."""
    threading.Thread(target=die_with_parent, daemon=True).start()
    os.nice(NICENESS)
    torch.set_num_threads(1)


_trials = cache(Trials)  # Of the one config


def _validate(
    config: RunConfig, weights: dict[str, NDArray[Any]], seeds: list[int]
) -> list[EpisodeResult]:
    """What `BehindTheScenes.begin` asks of its process."""
    trials = _trials(config)
    env = trials.envs[0]
    actor = Actor(env.action_space.shape[0], config.learner.frames, env.observation_space)
    actor.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return trials.drive(TogetherDriver(actor.eval().act), seeds)
