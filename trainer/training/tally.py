"""What an episode adds up while it is driven, and the row of metrics that it ends as."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import Losses
from trainer.training.metrics import EpisodeMetrics


@dataclass
class Tally:
    """Sums over one training episode."""

    rewards: float = 0.0
    interventions: int = 0
    human_steps: int = 0
    steps: int = 0
    environment_s: float = 0.0
    acting_s: float = 0.0
    learning_s: float = 0.0
    losses: list[Losses] = field(default_factory=list)

    def mean_losses(self) -> list[float]:
        """Critic, policy and cloning loss and value, averaged; nan without an update."""
        if not self.losses:
            return [float("nan")] * 4
        return [float(mean) for mean in np.mean([losses[:4] for losses in self.losses], axis=0)]

    def summary(
        self, exploration_std: float, episode: int, replay: ReplayBuffer, info: dict[str, Any]
    ) -> EpisodeMetrics:
        """The episode's metrics; ``info`` is that of its last step."""
        critic, policy, cloning, value = self.mean_losses()
        policy_priority, human_priority = replay.mean_priorities()
        return EpisodeMetrics(
            episode=episode,
            total_steps=replay.added,
            steps=self.steps,
            episode_return=float(self.rewards),
            distance_m=float(info["distance_m"]),
            outcome=info["outcome"],
            interventions=self.interventions,
            human_steps=self.human_steps,
            exploration_std=exploration_std,
            critic_loss=critic,
            policy_loss=policy,
            cloning_loss=cloning,
            value=value,
            policy_priority=policy_priority,
            human_priority=human_priority,
            environment_s=self.environment_s,
            acting_s=self.acting_s,
            learning_s=self.learning_s,
            validation_success=float("nan"),
            validation_distance_m=float("nan"),
        )
