"""Recorded sittings as the entries of a view; the road is not recorded, but driven again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trainer.drivers import make_environment
from trainer.human.guide import Reason
from trainer.person.recording import Step, read_steps
from trainer.training.metrics import NAMES, EpisodeMetrics
from trainer.viewer.entries import Entry, Episode, Picture, StepEntry, Steps


@dataclass
class Shown:
    """What a view of sittings amounts to."""

    steps: int = 0
    human_steps: int = 0
    episodes: int = 0
    without_road: int = 0
    """Episodes whose scenario drives differently today: their road is not shown."""
    _envs: dict[str, Any] = field(default_factory=dict)

    def entries(self, paths: Iterable[Path]) -> Iterator[Entry]:
        """Everything in these recordings, end to end; each episode ends with its own entry."""
        for path in paths:
            for episode in _episodes(read_steps(path)):
                yield from self._episode(episode)

    def _episode(self, episode: list[Step]) -> Iterator[Entry]:
        road = self._drive_again(episode)
        for step, scene in zip(episode, road, strict=True):
            policy = math.nan if step.policy_action is None else step.policy_action
            reason: Reason | None = "person" if step.human else None
            entry = StepEntry(self.steps, policy, step.action, step.speed_mps, reason)
            yield Steps([entry], Picture(self.steps, step.observation, scene))
            self.steps += 1
        self.human_steps += sum(step.human for step in episode)
        self.without_road += not road[0]
        yield Episode(self.steps - 1, _metrics(self.episodes, self.steps, episode), [], None)
        self.episodes += 1

    def _drive_again(self, episode: list[Step]) -> list[dict[str, Any]]:
        """The scene at each step, by the same seed and the same actions; empty where it differs."""
        first = episode[0]
        nothing: list[dict[str, Any]] = [{}] * len(episode)
        if first.step != 0:
            return nothing  # Its beginning was in another file, which is gone.
        env = self._envs.setdefault(first.scenario, make_environment(first.scenario))
        observation, _ = env.reset(seed=first.seed)
        scenes = []
        for step in episode:
            if not np.array_equal(observation, step.observation):
                return nothing
            scenes.append(env.scene())
            observation, *_ = env.step(np.array([step.action], np.float32))
        return scenes


def _episodes(steps: Iterable[Step]) -> Iterator[list[Step]]:
    episode: list[Step] = []
    for step in steps:
        if episode and step.episode != episode[0].episode:
            yield episode
            episode = []
        episode.append(step)
    if episode:
        yield episode


def _metrics(number: int, total_steps: int, episode: list[Step]) -> EpisodeMetrics:
    """What a recording tells of an episode; what only a learner knows is nan."""
    known: dict[str, Any] = {
        "episode": number,
        "total_steps": total_steps,
        "steps": len(episode),
        "episode_return": sum(step.reward for step in episode),
        "outcome": episode[-1].outcome or "cut off",
        "interventions": sum(step.first for step in episode),
        "human_steps": sum(step.human for step in episode),
    }
    return EpisodeMetrics(**{**dict.fromkeys(NAMES, math.nan), **known})
