"""An environment whose every step a person sees and a recording keeps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainer.person.sitting import Sitting
from trainer.scenarios.environment import Action, Step


class WatchedEnv:
    """A scenario's environment in a sitting; all else is the scenario's own.

    Args:
        env: the scenario.
        sitting: whoever sits there.
    """

    def __init__(self, env: Any, sitting: Sitting) -> None:
        self._env, self._sitting = env, sitting
        self.episode = 0
        """The number of the next episode."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, seed: int) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start an episode, once the person is there.

        Raises:
            SittingOver: the person quits instead.
        """
        observation, info = self._env.reset(seed=seed)
        self._sitting.begin(observation, self.episode, seed)
        return observation, info

    def step(self, action: Action) -> Step:
        """One control period; the person may end the episode after it, which truncates it."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        outcome = info.get("outcome")
        truncated, outcome = self._sitting.moved(
            observation, float(reward), terminated, truncated, outcome
        )
        if outcome is not None:
            info = {**info, "outcome": outcome}
        return observation, reward, terminated, truncated, info
