"""One control period of training, for whoever looks on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainer.human.guide import Intervention


@dataclass(frozen=True)
class Seen:
    """What the loop knows of it once it is stored; nothing in it changes afterwards."""

    observation: NDArray[np.uint8]
    """s, [2, 45, 80]."""
    policy_action: NDArray[np.float32]
    """With the exploration's noise, as the vehicle would have had it."""
    intervention: Intervention | None
    action: NDArray[np.float32]
    """What was carried out."""
    speed_mps: float
    """After the step."""


OnStep = Callable[[Seen], None]
