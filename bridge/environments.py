"""Finding the environment to serve, and checking that it keeps the contract of the wire.

The bridge knows environments only by name: it is given a gymnasium id and imports nothing of the
trainer itself.
"""

from __future__ import annotations

import re
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from edge_runtime.cli import UserError
from edge_runtime.wire import FRAMES_SHAPE

SCENARIOS = {
    "left_turn": "trainer.scenarios:phil/LeftTurn-v0",
    "congestion": "trainer.scenarios:phil/Congestion-v0",
}
"""Scenario word on the command line -> gymnasium id, with the module that registers it."""

HINT = f"use {', '.join(SCENARIOS)}, a gymnasium id, or module:id"
_NAME = re.compile(r"(?:\w+(?:\.\w+)*:)?[^:\s]+")


def make_environment(name: str) -> gymnasium.Env[Any, Any]:
    """Make the environment of a scenario word, a gymnasium id or ``module:id``.

    Raises UserError for an unknown name, a module that does not import, or an environment whose
    observation or action space the wire cannot carry.
    """
    environment_id = SCENARIOS.get(name, name)
    if not _NAME.fullmatch(environment_id):
        raise UserError(f"{name!r} names no environment; {HINT}")
    try:
        environment = gymnasium.make(environment_id)
    except (gymnasium.error.Error, ImportError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"no environment {name!r}: {first_line} ({HINT})") from error
    _check_spaces(environment, name)
    return environment


def _check_spaces(environment: gymnasium.Env[Any, Any], name: str) -> None:
    observation, action = environment.observation_space, environment.action_space
    frames = isinstance(observation, Box) and observation.shape == FRAMES_SHAPE
    if not frames or observation.dtype != np.uint8:
        raise UserError(
            f"environment {name!r} observes {observation}; the wire carries uint8 {FRAMES_SHAPE}"
        )
    bounded = isinstance(action, Box) and np.all(action.low == -1) and np.all(action.high == 1)
    if not bounded or len(action.shape or ()) != 1:
        raise UserError(f"environment {name!r} acts in {action}; the wire carries Box(-1, 1, (n,))")


def brake_action(environment: gymnasium.Env[Any, Any]) -> np.ndarray:
    """Return the full-brake action, float32 [n]: the environment's own, or -1 throughout."""
    own = getattr(environment.unwrapped, "brake_action", None)
    if own is not None:
        return np.asarray(own, dtype=np.float32)
    return np.full(environment.action_space.shape or (1,), -1.0, dtype=np.float32)


def scene_of(environment: gymnasium.Env[Any, Any]) -> dict[str, Any] | None:
    """Return the picture seen from above, for viewers only; None if there is none."""
    scene = getattr(environment.unwrapped, "scene", None)
    return scene() if callable(scene) else None
