"""The plain version of our learner, to compare the quick one with."""

from __future__ import annotations

from unittest.mock import patch

from trainer.benches.updates import Learner
from trainer.learner.algorithms import Algorithm
from trainer.learner.config import LearnerConfig
from trainer.learner.kernel import trunk
from trainer.learner.replay import Batch
from trainer.learner.td3 import Losses, TD3Learner


def reference_learner(config: LearnerConfig, algorithm: Algorithm, seed: int) -> Learner:
    """The same update by torch's own operations only."""
    return _WithoutKernel(config, algorithm, seed)


class _WithoutKernel(TD3Learner):
    """What ``PHIL_KERNEL=0`` gives, beside a learner with the kernel in the same process."""

    def update(self, batch: Batch, beta: float = 0.0) -> Losses:
        with patch.object(trunk, "_library", return_value=None):
            return super().update(batch, beta)
