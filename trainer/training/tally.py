"""What an episode adds up while it is driven, and the row of metrics that it ends as."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trainer.training.learning import EpisodeLearning
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
    storing_s: float = 0.0

    def summary(
        self,
        episode: int,
        total_steps: int,
        updates: int,
        exploration_std: float,
        learned: EpisodeLearning,
        info: dict[str, Any],
    ) -> EpisodeMetrics:
        """The episode's metrics; ``info`` is that of its last step."""
        return EpisodeMetrics(
            episode=episode,
            total_steps=total_steps,
            updates=updates,
            steps=self.steps,
            episode_return=float(self.rewards),
            distance_m=float(info["distance_m"]),
            outcome=info["outcome"],
            interventions=self.interventions,
            human_steps=self.human_steps,
            exploration_std=exploration_std,
            critic_loss=learned.critic_loss,
            policy_loss=learned.policy_loss,
            cloning_loss=learned.cloning_loss,
            value=learned.value,
            policy_priority=learned.policy_priority,
            human_priority=learned.human_priority,
            environment_s=self.environment_s,
            acting_s=self.acting_s,
            storing_s=self.storing_s,
            learning_s=learned.learning_s,
            waiting_s=learned.waiting_s,
            validation_success=float("nan"),
            validation_distance_m=float("nan"),
            validation_reward=float("nan"),
        )
