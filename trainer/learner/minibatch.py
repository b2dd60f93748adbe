"""What goes into an update and what comes out of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


class Losses(NamedTuple):
    """What one update reports; ``priorities`` are the batch's new ones (eq. 21)."""

    critic: float
    policy: float
    cloning: float
    mean_value: float
    priorities: NDArray[np.float64]


class Minibatch(NamedTuple):
    """A ``Batch`` as tensors on the learner's device; the fields are described there."""

    frames: Tensor
    actions: Tensor
    rewards: Tensor
    next_frames: Tensor
    terminals: Tensor
    human: Tensor
    probabilities: Tensor


class Outcome(NamedTuple):
    """What one update found, on the learner's device."""

    losses: Tensor
    """Critic, policy and cloning loss and mean value: [4]."""
    priorities: Tensor
    """The batch's new priorities (eq. 21), [n]."""
