"""Training the human model: it drives, the person intervenes, and it learns from that (DAgger)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from trainer import seeds
from trainer.drivers import EXPERTS, TRIGGERS
from trainer.human.guide import HumanGuide
from trainer.human.model import HumanModel, HumanModelConfig


@dataclass(frozen=True)
class HumanEpisode:
    """One episode of the human model's training."""

    outcome: str
    interventions: int
    demonstrations: int
    """The human's steps so far."""
    loss: float


class HumanTraining:
    """Online, incremental imitation of the person at the wheel (section V).

    Args:
        env: a scenario.
        config: tables A4 and A7.
        seed: of weights, minibatches and episodes.
    """

    def __init__(self, env: Any, config: HumanModelConfig, seed: int) -> None:
        self.env, self.config, self.seed = env, config, seed
        expert = EXPERTS[env.scenario](env)
        self.expert = expert
        # With a memory of its own: whoever takes over looks at the scene afresh.
        self.adviser = EXPERTS[env.scenario](env)
        self.guide = HumanGuide(expert, TRIGGERS[env.scenario](expert))
        self.model = HumanModel(config, seed, env.action_space.shape[0])

    def episodes(self) -> Iterator[HumanEpisode]:
        """Drive and learn, episode by episode."""
        for episode in range(self.config.episodes):
            interventions, outcome = self._drive(episode)
            loss = self.model.learn(self.config.updates_per_episode)
            yield HumanEpisode(outcome, interventions, self.model.demonstrations, loss)

    def _drive(self, episode: int) -> tuple[int, str]:
        """One episode; the number of take-overs, and the outcome."""
        c = self.config
        demonstrated = _nth(episode, c.demonstrated_share, c.demonstrated_share - 1)
        unaided = _nth(episode, c.unaided_share, 0)
        seed = seeds.episode_seed(self.seed, seeds.HUMAN_EPISODES, episode)
        observation, info = self.env.reset(seed=seed)
        self.guide.reset()
        self.adviser.reset()
        interventions, ended = 0, False
        while not ended:
            action = self.model.act(observation)
            watched = not (demonstrated or unaided)
            intervention = self.guide.watch(observation, action) if watched else None
            if demonstrated or intervention is not None:
                action = (
                    self.expert.act(observation) if intervention is None else intervention.action
                )
                self.model.add(observation, action)
            elif c.label_every_step:
                self.model.add(observation, self.adviser.act(observation))
            interventions += intervention is not None and intervention.first
            observation, _, terminated, truncated, info = self.env.step(action)
            ended = terminated or truncated
        return interventions, info["outcome"]


def _nth(episode: int, share: int, rest: int) -> bool:
    """Whether it is one in ``share``, from number ``rest`` on; with a share of 0 none is."""
    return share > 0 and episode % share == rest
