"""What goes from the training loop to whoever draws it: plain values, handed over whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainer.human.guide import Reason
from trainer.learner.networks import Critic
from trainer.training.metrics import EpisodeMetrics


class StepEntry(NamedTuple):
    """The numbers of one control period."""

    step: int
    """Since the run began."""
    policy_action: float
    action: float
    speed_mps: float
    reason: Reason | None
    """Why the human acted; None where the policy did."""


@dataclass(frozen=True)
class Picture:
    """What is looked at, not more than ten times a second."""

    step: int
    frames: NDArray[np.uint8]
    scene: dict[str, Any]
    """Of the environment; empty where the road is not known."""


@dataclass(frozen=True)
class Correction:
    """A step at which the human acted."""

    step: int
    frames: NDArray[np.uint8]
    policy_action: NDArray[np.float32]
    action: NDArray[np.float32]


@dataclass(frozen=True)
class Steps:
    """Some control periods, and perhaps the picture of the last one."""

    entries: list[StepEntry]
    picture: Picture | None


@dataclass(frozen=True)
class Episode:
    """An episode's end."""

    step: int
    metrics: EpisodeMetrics
    corrections: list[Correction]
    critic: Critic | None
    """A copy that nobody trains; None without corrections."""


Entry = Steps | Episode
