"""A training run that a person guides: paced, recorded, and never waiting for an update."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_runtime.util import UserError, counted
from trainer.human.guide import Guide
from trainer.learner.config import ALGORITHMS
from trainer.person.episode import KeptBack
from trainer.person.guide import PersonGuide
from trainer.person.interface import Person
from trainer.person.recording import DIRECTORY, DISCARDED, Recorder
from trainer.person.recovery import steps_since, store_again
from trainer.person.sitting import Sitting, SittingOver
from trainer.person.unhurried import UnhurriedLearning
from trainer.person.watched import WatchedEnv
from trainer.training.config import RunConfig
from trainer.training.delayed import make_wheel, ticks_late
from trainer.training.learning import Learning, LearningThread
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun, divergence_said


class PersonRun(TrainingRun):
    """``TrainingRun`` in a sitting; what an episode has shown is stored at its end.

    Args:
        config: what to train; ``human`` is ``options.PERSON``.
        run_dir: where everything goes; the recordings into ``sittings`` there.
        person: hands and eyes; closed with the run.
        resume: go on from the checkpoint, and from what was recorded after it.
        speed: simulated seconds in one of the person's.

    Raises:
        UserError: settings that leave no place for a person.
    """

    def __init__(
        self,
        config: RunConfig,
        run_dir: Path,
        person: Person,
        resume: bool = False,
        speed: float = 1.0,
    ) -> None:
        check_settings(config)
        self._resumed = resume
        self.longest_save_s = 0.0
        """The longest that a checkpoint has kept the person between two episodes."""
        self.recovered = (0, 0)
        """Steps, and the person's among them, that a kill had kept from the checkpoint."""
        super().__init__(config, run_dir, resume)
        recorder = Recorder(run_dir / DIRECTORY)
        self.sitting = Sitting(person, recorder, self.env, speed=speed)
        self.guide = PersonGuide(self.sitting)
        self.kept_back = KeptBack(self.learning)
        self.wheel = make_wheel(self.kept_back, self.env, self.network)
        self.watched = self.env = WatchedEnv(self.env, self.sitting)

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
            self.sitting.close()

    def quit(self) -> bool:
        """Ask for the end of the sitting; False where it is over already."""
        return self.sitting.quit()

    def advance(self) -> EpisodeMetrics:
        """Train one episode, and rest."""
        self.watched.episode = self.episode
        metrics = super().advance()
        metrics.outcome = self.sitting.rest(metrics.outcome)
        self.kept_back.release(discarded=metrics.outcome == DISCARDED)
        metrics.total_steps = self.learning.added
        self.sitting.progress = (
            f"{counted(self.learning.added, 'step')} stored, {self.sitting.human_steps} yours in "
            f"{counted(self.sitting.interventions, 'intervention')} of this sitting; "
            f"{self._learned(metrics.critic_loss)}, return {metrics.episode_return:.1f}"
        )
        return metrics

    def save(self) -> None:
        """Write the checkpoint, which the person sees."""
        self.sitting.announce("saving")
        began_s = time.perf_counter()
        with divergence_said(self.episode):  # The update under way may be the one.
            super().save()
        self.longest_save_s = max(self.longest_save_s, time.perf_counter() - began_s)

    def _learned(self, critic_loss: float) -> str:
        """What the learner did in an episode: nothing before its warm-up is over."""
        warmup = self.config.learner.warmup_steps
        if self.learning.added < warmup:
            return f"not learning yet ({self.learning.added} of {warmup} steps)"
        return "critic loss –" if math.isnan(critic_loss) else f"critic loss {critic_loss:.3f}"

    def _around(self, learning: LearningThread) -> Learning:
        return UnhurriedLearning(learning)

    def _make_guide(self) -> Guide | None:
        return None  # The sitting is opened when all else is known to work.

    def _must_stop(self, deadline_s: float) -> bool:
        return self.sitting.stop or super()._must_stop(deadline_s)

    def _validate(self, metrics: EpisodeMetrics, at_end: bool) -> None:
        """Only at a sitting's end, behind its closed window: a person is not to wait."""
        if not at_end:
            return
        self.save()
        self.sitting.close()
        if self.config.evaluate_every_steps:
            print(
                f"validating on {self.config.evaluation_runs} episodes; all is saved, "
                "^C leaves it out",
                file=sys.stderr,
                flush=True,
            )
        try:
            super()._validate(metrics, at_end)
        except KeyboardInterrupt:
            print("validation left out", file=sys.stderr)

    def _due(self, last_steps: int) -> bool:
        return True  # Whenever it is done: a person's run has no other end than a sitting's.

    def _more_state(self) -> dict[str, Any]:
        return {"recorded": list(self.sitting.recorder.position)}

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        position = tuple(state["recorded"])
        steps = steps_since(self.run_dir / DIRECTORY, position)
        self.recovered = store_again(
            self.learning, steps, self._shape, self._penalises, ticks_late(self.network)
        )


def check_settings(config: RunConfig) -> None:
    """Refuse what a person cannot be a part of; raises UserError."""
    if not ALGORITHMS[config.algorithm].guided:
        raise UserError(f"{config.algorithm} takes no guidance: nobody could take over")
    if config.guided_share != 1:
        raise UserError("a person watches every episode: guided_share is 1")
    if config.poor_guidance_share:
        raise UserError("a person's actions are not replaced: poor_guidance_share is 0")
