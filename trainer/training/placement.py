"""Where a run learns."""

from __future__ import annotations

import torch

from edge_runtime.errors import UserError
from trainer.learner.algorithms import Algorithm
from trainer.training.accelerator import AcceleratorLearning
from trainer.training.config import RunConfig
from trainer.training.learning import Learning, ProcessorLearning


def make_learning(config: RunConfig, algorithm: Algorithm, action_size: int) -> Learning:
    """Learner and replay on the configured device; UserError where its memory holds no replay."""
    try:
        return _make_learning(config, algorithm, action_size)
    except (MemoryError, torch.OutOfMemoryError):
        raise UserError(
            "there is no memory for a replay buffer of "
            f"{config.learner.replay_capacity} transitions: --set replay_capacity=N, a smaller one"
        ) from None


def _make_learning(config: RunConfig, algorithm: Algorithm, action_size: int) -> Learning:
    if config.device != "cpu":
        return AcceleratorLearning(
            config.learner, algorithm, config.seed, action_size, config.device
        )
    return ProcessorLearning(config.learner, algorithm, config.seed, action_size)
