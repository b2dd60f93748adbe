"""How long the bench may look at each thing."""

from __future__ import annotations

from dataclasses import dataclass

from trainer.learner.config import LearnerConfig


@dataclass(frozen=True)
class Effort:
    """Counts. More of them give the same figures with less noise."""

    batch_size: int = LearnerConfig.batch_size
    """Transitions in a minibatch of every learner (table A5)."""
    learner_rounds: int = 20
    updates_per_round: int = 5
    environment_rounds: int = 20
    steps_per_round: int = 200
    """For each scenario and contender; about three episodes."""
    training_episodes: int = 10
    """Counted ones: those before the first update come on top."""
    own_updates: int = 5
    """The learner alone, between two episodes of the training."""
    replay_transitions: int = 100_000
    """Capacity of the buffer, and what it holds (table A6)."""
    replay_draws: int = 200
    memory_episodes: int = 5


FULL = Effort()
QUICK = Effort(
    learner_rounds=4,
    updates_per_round=3,
    environment_rounds=4,
    training_episodes=3,
    own_updates=3,
    replay_draws=50,
    memory_episodes=3,
)
"""A look, not a measurement."""
