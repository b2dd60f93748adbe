"""Learning that has diverged: found where it shows first, and said in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from edge_runtime.util import UserError
from trainer.learner.td3 import TD3Learner
from trainer.training.learning import Action

NETWORKS = ("actor", "critics", "target_actor", "target_critics")


@contextmanager
def divergence_said(episode: int) -> Iterator[None]:
    """Turn the FloatingPointError of learning that diverged into a UserError.

    Args:
        episode: the one under way, from 0; people count from 1.
    """
    try:
        yield
    except FloatingPointError as error:
        raise UserError(
            f"the training diverged in episode {episode + 1}: {error}; a smaller "
            "--set actor_learning_rate or critic_learning_rate may help"
        ) from None


def finite_action(action: Action) -> Action:
    """The action; FloatingPointError where it is none: no car is to be driven by it."""
    if not np.isfinite(action).all():
        raise FloatingPointError("its actions are no longer finite")
    return action


def check_weights(learner: TD3Learner) -> None:
    """Raise FloatingPointError unless every weight is finite: a checkpoint without is worthless."""
    for name in NETWORKS:
        for parameter in getattr(learner, name).parameters():
            if not parameter.isfinite().all():
                raise FloatingPointError("its weights are no longer finite")
