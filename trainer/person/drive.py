"""Driving without learning: a person alone, or over a policy's shoulder."""

from __future__ import annotations

from collections import Counter

import numpy as np

from trainer import seeds
from trainer.human.guide import Driver
from trainer.person.sitting import Sitting, SittingOver
from trainer.person.watched import WatchedEnv


def drive(
    sitting: Sitting, policy: Driver | None, run_seed: int, episodes: int | None
) -> Counter[str]:
    """Drive until the person quits, or so many episodes.

    Args:
        sitting: whoever sits there.
        policy: from whom the person takes over; None: from nobody.
        run_seed: decides the episodes, which are others in every sitting.
        episodes: how many; None: no end.

    Returns:
        How often an episode ended how.
    """
    env, outcomes = WatchedEnv(sitting.env, sitting), Counter[str]()
    number = sitting.recorder.sitting
    while not sitting.stop and outcomes.total() != episodes:
        seed = seeds.episode_seed(run_seed, seeds.SITTINGS, (number << 32) + env.episode)
        try:
            outcome = _episode(env, sitting, policy, seed)
        except SittingOver:
            break
        outcome = sitting.rest(outcome)
        outcomes[outcome] += 1
        env.episode += 1
        sitting.progress = ", ".join(f"{count} {word}" for word, count in outcomes.items())
    return outcomes


def _episode(env: WatchedEnv, sitting: Sitting, policy: Driver | None, seed: int) -> str:
    """One episode; how it ended."""
    observation, info = env.reset(seed=seed)
    if policy is not None:
        policy.reset()
    ended = False
    while not ended:
        policy_action = None if policy is None else float(policy.act(observation)[0])
        applied = sitting.decide(observation, policy_action)
        action = np.array([applied.action], np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
    return str(info["outcome"])
