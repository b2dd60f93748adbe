"""Driving episodes in process, and what they amount to."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from edge_runtime.episode_report import EpisodeResult
from edge_runtime.latency.model import LatencySpec
from trainer.conditions import CONDITIONS
from trainer.human.guide import Driver
from trainer.remote.vehicle_end import RemoteDriver

NO_NETWORK = LatencySpec()


def drive_episode(
    env: Any,
    driver: Driver,
    seed: int,
    noise_std: float = 0.0,
    latency: LatencySpec = NO_NETWORK,
) -> EpisodeResult:
    """Drive one episode.

    Args:
        env: a scenario.
        driver: who drives.
        seed: of the episode, and of the noise.
        noise_std: standard deviation of Gaussian noise on the command.
        latency: the network between driver and vehicle, in virtual time.
    """
    noise = np.random.default_rng([seed, 1])
    observation, info = env.reset(seed=seed)
    if latency != NO_NETWORK:
        driver = RemoteDriver(driver, env, latency, seed)
    driver.reset()
    actions, rewards, lateral, longitudinal = [], [], [], []
    ended = False
    while not ended:
        action = driver.act(observation)
        if noise_std:
            disturbed = action + noise.normal(0.0, noise_std, action.shape)
            action = np.clip(disturbed, -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        actions.append([float(a) for a in action])
        rewards.append(reward)
        lateral.append(abs(info["lateral_acceleration_mps2"]))
        longitudinal.append(abs(info["longitudinal_acceleration_mps2"]))
        ended = terminated or truncated
    return EpisodeResult(
        seed=seed,
        outcome=info["outcome"],
        distance_m=float(info["distance_m"]),
        reward=float(sum(rewards)),
        time_s=len(actions) * env.config.control_period_s,
        lateral_acceleration_mps2=float(np.mean(lateral)),
        longitudinal_acceleration_mps2=float(np.mean(longitudinal)),
        steps=len(actions),
        actions=actions,
    )


def drive_episodes(
    env: Any,
    driver: Driver,
    seeds: Iterable[int],
    condition: str = "nominal",
    on_episode: Callable[[EpisodeResult], None] = lambda result: None,
    latency: LatencySpec = NO_NETWORK,
) -> list[EpisodeResult]:
    """Drive one episode for each seed under a condition.

    Its noise is added here; its scene is the environment's own (``drivers.make_environment``).
    """
    noise_std = CONDITIONS[condition].noise_std
    results = []
    for seed in seeds:
        results.append(drive_episode(env, driver, seed, noise_std, latency))
        on_episode(results[-1])
    return results
