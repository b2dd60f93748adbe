"""Minibatches for learners, whether two learners are equal, and tests for GPUs."""

from typing import Any

import numpy as np
import pytest
import torch

from trainer.learner.config import LearnerConfig
from trainer.learner.replay import Batch
from trainer.learner.td3 import NETWORKS, TD3Learner

on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

SMALL = LearnerConfig(precision="float32", saturation_weight=0.0, tau=1e-3, picture_shift=0)


def make_batch(seed: int = 0, humans: int = 4, size: int = 12, foreseen: bool = False) -> Batch:
    random = np.random.default_rng(seed)
    pictures = random.integers(0, 255, (size, 3, 45, 80)).astype(np.uint8)
    return Batch(
        indices=np.arange(size),
        frames=pictures[:, :2],
        actions=random.uniform(-1, 1, (size, 1)).astype(np.float32),
        rewards=random.normal(size=size).astype(np.float32),
        next_frames=pictures[:, 1:],
        terminals=(random.random(size) < 0.2).astype(np.float32),
        human=np.arange(size) < humans,
        probabilities=random.uniform(0.5, 1.5, size) / size,
        spans=random.integers(1, 9, size),
        overruled=random.uniform(-1, 1, (size, 1)).astype(np.float32),
        penalised=(np.arange(size) < humans) & (np.arange(size) % 2 == 0),
        foreseen=None if foreseen else make_batch(seed + 100, size=5, foreseen=True),
    )


def weights_of(learner: Any) -> dict[str, torch.Tensor]:
    return {
        name: torch.cat([p.detach().flatten() for p in getattr(learner, name).parameters()])
        for name in NETWORKS
    }


def same_weights(one: TD3Learner, other: TD3Learner) -> bool:
    found = weights_of(other)
    return all(torch.equal(flat, found[name]) for name, flat in weights_of(one).items())
