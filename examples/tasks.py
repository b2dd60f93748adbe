"""Two environments of other packages with an end and a goal, for the experiment on guidance.

In a clone: ``python -m trainer train --scenario examples.tasks:examples/Hill-v0 --human
examples.tasks:HillExpert --out runs/hill``
"""

from typing import Any

import gymnasium
import numpy as np


class Racetrack(gymnasium.Wrapper[Any, Any, Any, Any]):
    """highway-env's racetrack-v0; the goal is half a minute on the road without a crash."""

    def __init__(self, **options: Any) -> None:
        import highway_env  # noqa: F401 (registers it)

        super().__init__(gymnasium.make("racetrack-v0", **options))

    def step(self, action: Any) -> Any:
        """Drive for one control period and report success."""
        *seen, info = self.env.step(action)
        car: Any = self.env.unwrapped
        well = not car.vehicle.crashed and car.vehicle.on_road
        return *seen, {**info, "is_success": bool(well)}


class Hill(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gymnasium's MountainCarContinuous-v0; the goal is the top of the hill.

    The car is too weak to drive up: it must roll to and fro. Rewards are a tenth of its own.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(gymnasium.make("MountainCarContinuous-v0", **options))

    def step(self, action: Any) -> Any:
        """Drive for one control period and report success."""
        seen, reward, terminated, *rest, info = self.env.step(action)
        return seen, 0.1 * float(reward), terminated, *rest, {**info, "is_success": terminated}


class HillExpert:
    """Pushes the way the car rolls, and takes over from a policy that wastes a swing."""

    PATIENCE = 5  # Control periods of pushing against it

    def __init__(self, env: Any) -> None:
        self.env, self.against = env, 0

    def reset(self) -> None:
        """Forget the last episode."""
        self.against = 0

    def act(self) -> np.ndarray:
        """Return the push, in [-1, 1]."""
        return np.array([1.0 if self.env.state[1] >= 0.0 else -1.0])

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        """Return why it takes over, or None."""
        wasted = float(policy_action[0]) * float(self.act()[0]) < 0.3
        self.against = self.against + 1 if wasted else 0
        return "wasted" if self.against > self.PATIENCE else None


gymnasium.register("examples/Racetrack-v0", Racetrack, max_episode_steps=150)
gymnasium.register("examples/Hill-v0", Hill, max_episode_steps=200)
