"""Environments of other packages, given an end and a goal for the experiment on guidance.

In a clone: ``python -m trainer train --scenario examples.tasks:examples/Hill-v0 --human
examples.tasks:HillExpert --out runs/hill``
"""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs.common.observation import OccupancyGridObservation
from highway_env.road.lane import StraightLane


def mark_road(grid: OccupancyGridObservation, layer: int, distance_m: float = 100.0) -> None:
    """Mark a grid's cells that contain road, as highway-env does, in a tenth of the time."""
    ego, spacing, points = grid.observer_vehicle, np.amin(grid.grid_step), []
    for lane in grid.env.road.network.lanes_list():
        at, _ = lane.local_coordinates(ego.position)
        along = np.arange(at - distance_m, at + distance_m, spacing).clip(0, lane.length)
        if type(lane) is StraightLane:
            points.append(lane.start + along[:, None] * lane.direction)
        else:  # A CircularLane: the racetrack has no other kind
            angle = lane.direction * along / lane.radius + lane.start_phase
            around = np.stack([np.cos(angle), np.sin(angle)], 1)
            points.append(lane.center + lane.radius * around)
    relative = np.concatenate(points) - ego.position
    if grid.align_to_vehicle_axes:
        cos, sin = np.cos(ego.heading), np.sin(ego.heading)
        relative = relative @ np.array([[cos, -sin], [sin, cos]])
    cells = np.floor((relative - grid.grid_size[:, 0]) / grid.grid_step).astype(int)
    cells = cells[((cells >= 0) & (cells < grid.grid.shape[-2:])).all(1)]
    grid.grid[layer, cells[:, 0], cells[:, 1]] = 1


class Racetrack(gymnasium.Wrapper[Any, Any, Any, Any]):
    """highway-env's racetrack-v0; the goal is half a minute on the road without a crash."""

    def __init__(self, **options: Any) -> None:
        super().__init__(gymnasium.make("racetrack-v0", **options))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation_and_info = self.env.reset(seed=seed, options=options)
        grid = self.env.get_wrapper_attr("observation_type")  # A new one in each episode
        grid.fill_road_layer_by_lanes = partial(mark_road, grid)
        return observation_and_info

    def step(self, action: Any) -> Any:
        *result, info = self.env.step(action)
        car = self.env.get_wrapper_attr("vehicle")
        is_well = not car.crashed and car.on_road
        return *result, {**info, "is_success": bool(is_well)}


class Hill(gymnasium.Wrapper[Any, Any, Any, Any]):
    """MountainCarContinuous-v0 with a tenth of its rewards; the goal is the top, by swinging."""

    def __init__(self, **options: Any) -> None:
        super().__init__(gymnasium.make("MountainCarContinuous-v0", **options))

    def step(self, action: Any) -> Any:
        observation, reward, ended, *rest, info = self.env.step(action)
        return observation, 0.1 * float(reward), ended, *rest, {**info, "is_success": ended}


class HillExpert:
    """Pushes the way the car rolls, and takes over from a policy that wastes a swing."""

    PATIENCE = 5  # Control periods in which the policy may push the other way

    def __init__(self, env: Any) -> None:
        self.env, self.against = env, 0

    def reset(self) -> None:
        self.against = 0

    def act(self) -> np.ndarray:
        return np.array([1.0 if self.env.state[1] >= 0.0 else -1.0])

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        wasted = float(policy_action[0]) * float(self.act()[0]) < 0.3
        self.against = self.against + 1 if wasted else 0
        return "wasted" if self.against > self.PATIENCE else None


class Lander(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gymnasium's LunarLanderContinuous-v3; the goal is to come to rest on the ground."""

    LANDED = 100.0  # Reward of the step in which it comes to rest

    def __init__(self, **options: Any) -> None:
        super().__init__(gymnasium.make("LunarLanderContinuous-v3", **options))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation, info = self.env.reset(seed=seed, options=options)
        self.unwrapped.observation = observation  # For the expert
        return observation, info

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.unwrapped.observation = observation
        landed = terminated and reward == self.LANDED
        return observation, reward, terminated, truncated, {**info, "is_success": landed}


class LanderExpert:
    """Gymnasium's own heuristic, which takes over from a policy that acts differently."""

    STRICT = 0.5  # Largest difference of actions, in [-1, 1]

    def __init__(self, env: Any) -> None:
        self.env = env

    def act(self) -> np.ndarray:
        from gymnasium.envs.box2d.lunar_lander import heuristic

        return np.clip(heuristic(self.env, self.env.observation), -1.0, 1.0)

    def wants_control(self, policy_action: np.ndarray) -> str | None:
        return "off" if np.abs(policy_action - self.act()).max() > self.STRICT else None


gymnasium.register("examples/Racetrack-v0", Racetrack, max_episode_steps=150)
gymnasium.register("examples/Hill-v0", Hill, max_episode_steps=200)
gymnasium.register("examples/Lander-v0", Lander, max_episode_steps=600)
