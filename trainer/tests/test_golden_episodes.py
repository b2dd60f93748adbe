"""Whole episodes, pinned: whoever makes a scenario faster must not change it.

A digest covers pictures to the bit and numbers to 1e-9, which is well above what another
libm or numpy build changes and well below what a changed model does. Where the scenario is
meant to change, print the new digests with `python -m trainer.tests.test_golden_episodes`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from trainer.drivers import EXPERTS, TRIGGERS, make_environment
from trainer.human.guide import HumanGuide
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv

QUEUE = LeftTurnConfig(traffic_cars=8, first_car_m=(-30.0, 12.0), short_gap_m=(7.0, 9.0))
"""A longer queue than usual, closely packed: the followers brake."""

GOLDEN = {
    "random": "99a651c9237ffb067728760ccd5fbf1279e7c4c5266122f08155fa63490e79ab",
    "expert": "3f816926ad56a5b6ad373eceedb1eea9b1f318576a4ee3a215a282b9036edf42",
    "guided": "0f2bcfc8346c08a9dd857cf4994cfe2db0f0989bc1a7437a5ab8530883dbdc26",
    "queue": "c252a806eb9146149777fb1c514a07e0acf34b762737cad66d265a74242ebcf1",
    "variant": "33f19cff22bc9157d7cd3de96d788ae39dca8a037c63fcd9fe3a008579504a1f",
    "congestion, random": "b446e260c41008d3a8301dd86dd874fff1637293bbbca9a8b7756923a44a6a6d",
    "congestion, expert": "4654583381419aa3977888a96dd3b299046bcfe12ced469540f95450dc1349b2",
    "congestion, variant": "9ced478a7e3e511b952c8fafa6d4d3640ddbbd929e905537c8cbf60cad3a0624",
    "dense": "321961c59e49aa7b9a1d5297b0b76f68d7f4a7a2a780e4eb72125ffefd7fa807",
    "congestion, dense": "26ec6b10e5023e4eb244fcd3f4ea19fedf8e2e3e3dd006d20b5ca484f4a2cdc8",
}


def random_driver(env: Any, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    """A restless action that favours one side: in the left turn the throttle."""
    random = np.random.default_rng(seed)
    while True:
        yield random.uniform(-0.6, 1.0, 1).astype(np.float32), ""


def expert_driver(env: Any, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    expert = EXPERTS[env.scenario](env)
    while True:
        yield expert.act(env.frames), ""


def guided_driver(env: Any, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    """A policy that drives on, then one that stands still, under the guide's eyes."""
    expert = EXPERTS[env.scenario](env)
    guide, policy = HumanGuide(expert, TRIGGERS[env.scenario](expert)), random_driver(env, seed)
    while True:
        action, _ = next(policy)
        if seed % 2:
            action = -np.abs(action)
        intervention = guide.watch(env.frames, action)
        if intervention is None:
            yield action, "passes"
        else:
            yield intervention.action, f"{intervention.reason} {intervention.first}"


EPISODES: dict[str, tuple[Any, Callable[[], Any], int]] = {
    "random": (random_driver, LeftTurnEnv, 8),
    "expert": (expert_driver, LeftTurnEnv, 6),
    "guided": (guided_driver, LeftTurnEnv, 8),
    "queue": (guided_driver, partial(LeftTurnEnv, QUEUE), 4),
    "variant": (expert_driver, partial(make_environment, "left_turn", "variant"), 4),
    "congestion, random": (random_driver, partial(make_environment, "congestion"), 6),
    "congestion, expert": (expert_driver, partial(make_environment, "congestion"), 2),
    "congestion, variant": (expert_driver, partial(make_environment, "congestion", "variant"), 2),
    "dense": (expert_driver, partial(make_environment, "left_turn", "dense"), 4),
    "congestion, dense": (expert_driver, partial(make_environment, "congestion", "dense"), 2),
}
"""Name -> who drives, in which environment, how many episodes."""


def numbers(*values: float) -> bytes:
    """Values to 1e-9; the sum takes the sign off a zero."""
    return " ".join(repr(round(float(value), 9) + 0.0) for value in values).encode()


def digest(name: str) -> str:
    drive, make, episodes = EPISODES[name]
    env, digest = make(), hashlib.sha256()
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        actions, ended = drive(env, seed), False
        while not ended:
            action, remark = next(actions)
            observation, reward, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            digest.update(observation.tobytes() + remark.encode())
            digest.update(str(info.pop("outcome", "")).encode())
            digest.update(numbers(*action, reward, *info.values()))
            for car in env.scene()["vehicles"]:
                digest.update(numbers(car["x"], car["y"], car["heading_rad"], car["speed_mps"]))
    return digest.hexdigest()


@pytest.mark.parametrize("name", EPISODES)
def test_episodes_are_what_they_were(name):
    assert digest(name) == GOLDEN[name]


if __name__ == "__main__":
    for episode_name in EPISODES:
        print(f'    "{episode_name}": "{digest(episode_name)}",')
