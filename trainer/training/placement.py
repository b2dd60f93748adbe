"""Where a run learns."""

from __future__ import annotations

from trainer.learner.algorithms import Algorithm
from trainer.training.accelerator import AcceleratorLearning
from trainer.training.config import RunConfig
from trainer.training.learning import Learning, ProcessorLearning


def make_learning(config: RunConfig, algorithm: Algorithm, action_size: int) -> Learning:
    """Learner and replay on the configured device."""
    if config.device != "cpu":
        return AcceleratorLearning(
            config.learner, algorithm, config.seed, action_size, config.device
        )
    return ProcessorLearning(config.learner, algorithm, config.seed, action_size)
