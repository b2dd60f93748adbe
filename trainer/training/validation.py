"""What a training policy is worth alone, on seeds of their own; the best one is kept."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from bridge.network import LatencySpec
from bridge.report import GOAL, EpisodeResult
from trainer import seeds
from trainer.drivers import BEST_FILE, NetworkDriver, make_environment
from trainer.evaluate import NO_NETWORK, drive_episodes, drive_together
from trainer.training.config import RunConfig
from trainer.training.learning import Action, Learning, Observation
from trainer.training.metrics import EpisodeMetrics
from trainer.util import save_torch


class LearningDriver(NetworkDriver):
    """The policy that is being learned, or its running average, asked where it is learned."""

    def __init__(self, learning: Learning, averaged: bool) -> None:
        self.learning, self.averaged = learning, averaged

    def act_together(self, observations: Observation) -> Action:
        """Actions float32 [n, action size] for observations [n, 2, 45, 80]."""
        return self.learning.act_together(observations, self.averaged)


class Validation:
    """Drives the policy as it stands, without help, and keeps the best actor so far.

    Args:
        config: of the run.
        run_dir: where the actor goes.
        learning: whose policy it is.
        network: between policy and vehicle, as in the training.
    """

    def __init__(
        self, config: RunConfig, run_dir: Path, learning: Learning, network: LatencySpec
    ) -> None:
        self.config, self.run_dir = config, run_dir
        self.learning, self.network = learning, network
        self._seeds = [
            seeds.episode_seed(config.seed, seeds.VALIDATION, run)
            for run in range(config.evaluation_runs)
        ]
        self.envs = [
            make_environment(config.scenario, printed_reward=config.printed_reward)
            for _ in self._seeds
        ]
        self.best = (-1.0, -1.0)
        """Success and return of the best actor of those validated when it was due."""
        self._best_actor: dict[str, Any] | None = None
        """As in its file; None before the first one."""

    def judge(self, metrics: EpisodeMetrics, episode: int, due: bool = True) -> None:
        """Add to ``metrics`` how the policy drives after ``episode`` episodes.

        One that was not ``due``, since the run stops early, may be kept as the best so far, but a
        resumed run forgets it: which actor a run ends with must not depend on when it was stopped.
        """
        results = self._drive()
        success = float(np.mean([result.outcome == GOAL for result in results]))
        reward = float(np.mean([result.reward for result in results]))
        metrics.validation_success, metrics.validation_reward = success, reward
        metrics.validation_distance_m = float(np.mean([result.distance_m for result in results]))
        if (success, reward) >= self.best:
            state = self._keep(episode)
            if due:
                self.best, self._best_actor = (success, reward), copy.deepcopy(state)

    def _drive(self) -> list[EpisodeResult]:
        driver = LearningDriver(self.learning, self.config.averaged_actor)
        if self.network == NO_NETWORK:
            return drive_together(self.envs, driver.act_together, self._seeds)
        return drive_episodes(self.envs[0], driver, self._seeds, latency=self.network)

    def _keep(self, episode: int) -> dict[str, Any]:
        actor = getattr(self.learning.learner, self.config.kept_actor)
        state = {**self.config.label(episode), "actor": actor.state_dict()}
        save_torch(self.run_dir / BEST_FILE, state)
        return state

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint holds of it."""
        return {"best_validation": self.best, "best_actor": self._best_actor}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave, and keep that actor again."""
        self.best = tuple(state["best_validation"])
        self._best_actor = state["best_actor"]
        if self._best_actor is not None:
            save_torch(self.run_dir / BEST_FILE, self._best_actor)
