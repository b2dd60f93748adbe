"""A small learner, and what it is filled and compared with."""

import numpy as np
import torch

from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import TD3Learner

SMALL = LearnerConfig(batch_size=8, replay_capacity=60, warmup_steps=1)


def observation(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (2, 45, 80)).astype(np.uint8)


def fill(learning, steps: int = 20) -> None:
    """An episode in which the human has every third step."""
    learning.start_episode(observation(0))
    for step in range(steps):
        action = np.array([step / steps], np.float32)
        learning.add(action, float(step % 5), observation(step + 1), False, step % 3 == 0)


def weights(learner: TD3Learner) -> torch.Tensor:
    networks = (learner.actor, learner.critics, learner.target_actor, learner.target_critics)
    return torch.cat([p.detach().flatten() for n in networks for p in n.parameters()]).cpu()
