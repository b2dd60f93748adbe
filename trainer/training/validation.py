"""Validation: the policy drives alone on seeds of their own, and the best actor is kept."""

import copy
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from bridge.network import parse_spec
from bridge.outcomes import GOAL
from bridge.report import EpisodeResult
from trainer.drivers import BEST_FILE, TogetherDriver
from trainer.environments import make_environment
from trainer.evaluation import NO_NETWORK, drive_episodes, drive_together
from trainer.learner.networks import Actor
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.learning import LearningThread
from trainer.training.metrics import EpisodeMetrics
from trainer.util import Purpose, episode_seed, save_torch


class Trials:
    """The validation's episodes: a policy drives them without help, over the run's network.

    ``env`` exists already: some simulators allow only one in a process.
    """

    def __init__(self, config: RunConfig, env: Any = None) -> None:
        self.config, self.network, self._env = config, parse_spec(config.latency), env
        self._seeds = [
            episode_seed(config.seed, Purpose.VALIDATION, run)
            for run in range(config.evaluation_runs)
        ]

    @cached_property
    def envs(self) -> list[Any]:
        """Environments driven at once: one a seed for our scenarios, else a single one."""
        c = self.config
        make = partial(
            make_environment, c.scenario, printed_reward=c.printed_reward, period_s=c.period_s
        )
        return [make() for _ in self._seeds] if c.scenario in SCENARIOS else [self._env or make()]

    def drive(self, driver: TogetherDriver, more: Sequence[int] = ()) -> list[EpisodeResult]:
        """Drive the validation seeds, then ``more`` seeds."""
        seeds = [*self._seeds, *more]
        if self.network == NO_NETWORK:
            return drive_together(self.envs, driver.act_together, seeds)
        return drive_episodes(self.envs[0], driver, seeds, latency=self.network)


class Validation(Trials):
    """Drives the policy as it stands, and keeps the best actor so far."""

    def __init__(
        self, config: RunConfig, run_dir: Path, learning: LearningThread, env: Any = None
    ) -> None:
        super().__init__(config, env)
        self.run_dir, self.learning = run_dir, learning
        self.best = (-1.0, -1.0)
        """Success and return of the best actor among the validations that were due."""
        self._best_actor: dict[str, Any] | None = None  # As in its file; None before the first one
        self.kept_episode: int | None = None  # After so many was the actor that the file holds

    def after(self, metrics: EpisodeMetrics, episode: int, due: bool, at_end: bool) -> None:
        """Validate after ``episode`` episodes where that is due, or at the end of a run."""
        if due or (at_end and self.config.evaluate_every_steps):
            self.judge(metrics, episode, due)

    def judge(self, metrics: EpisodeMetrics, episode: int, due: bool = True) -> None:
        """Validate the policy as it stands, into ``metrics``; keep it if it is the best so far.

        A resumed run forgets a validation that was not ``due`` but came from an early stop: when a
        run was stopped must not decide which actor it ends with.
        """
        actor = getattr(self.learning.learner, self.config.kept_actor)
        driver = TogetherDriver(partial(self.learning.in_thread, actor.act))
        self.take(self.drive(driver), actor, metrics, episode, due)

    def take(
        self,
        results: Sequence[EpisodeResult],
        actor: Actor,
        metrics: EpisodeMetrics,
        episode: int,
        due: bool = True,
    ) -> None:
        """Enter an actor's drives into ``metrics``, and keep the actor if it is the best."""
        success = float(np.mean([result.outcome == GOAL for result in results]))
        reward = float(np.mean([result.reward for result in results]))
        metrics.validation_success, metrics.validation_reward = success, reward
        metrics.validation_distance_m = float(np.mean([result.distance_m for result in results]))
        state = {**self.config.label(episode), "actor": actor.state_dict()}
        if (success, reward) >= self.best:
            save_torch(self.run_dir / BEST_FILE, state)
            self.kept_episode = episode
            if due:
                self.best, self._best_actor = (success, reward), copy.deepcopy(state)

    def state_dict(self) -> dict[str, Any]:
        return {"best_validation": self.best, "best_actor": self._best_actor}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up ``state_dict``, and write its best actor again."""
        self.best = tuple(state["best_validation"])
        self._best_actor = state["best_actor"]
        if self._best_actor is not None:
            save_torch(self.run_dir / BEST_FILE, self._best_actor)
            self.kept_episode = self._best_actor["episode"]
        else:  # What is there was validated before it was due.
            (self.run_dir / BEST_FILE).unlink(missing_ok=True)
