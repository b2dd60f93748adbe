"""Whole episodes, pinned: whoever makes the scenario faster must not change it.

A digest covers pictures to the bit and numbers to 1e-9, which is well above what another
libm or numpy build changes and well below what a changed model does. Where the scenario is
meant to change, print the new digests with `python -m trainer.tests.test_golden_episodes`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from trainer.human.expert import LeftTurnExpert
from trainer.human.guide import HumanGuide
from trainer.human.trigger import LeftTurnTrigger
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv

QUEUE = LeftTurnConfig(traffic_cars=8, first_car_m=(-30.0, 12.0), short_gap_m=(7.0, 9.0))
"""A longer queue than usual, closely packed: the followers brake."""

GOLDEN = {
    "random": "99a651c9237ffb067728760ccd5fbf1279e7c4c5266122f08155fa63490e79ab",
    "expert": "3f816926ad56a5b6ad373eceedb1eea9b1f318576a4ee3a215a282b9036edf42",
    "guided": "0f2bcfc8346c08a9dd857cf4994cfe2db0f0989bc1a7437a5ab8530883dbdc26",
    "queue": "c252a806eb9146149777fb1c514a07e0acf34b762737cad66d265a74242ebcf1",
}


def random_pedal(env: LeftTurnEnv, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    """A restless foot that favours the throttle, so that it gets somewhere."""
    random = np.random.default_rng(seed)
    while True:
        yield random.uniform(-0.6, 1.0, 1).astype(np.float32), ""


def expert_pedal(env: LeftTurnEnv, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    expert = LeftTurnExpert(env)
    while True:
        yield expert.act(env.frames), ""


def guided_pedal(env: LeftTurnEnv, seed: int) -> Iterator[tuple[np.ndarray, str]]:
    """A policy that drives on, then one that stands still, under the guide's eyes."""
    expert = LeftTurnExpert(env)
    guide, policy = HumanGuide(expert, LeftTurnTrigger(expert)), random_pedal(env, seed)
    while True:
        action, _ = next(policy)
        if seed % 2:
            action = -np.abs(action)
        intervention = guide.watch(env.frames, action)
        if intervention is None:
            yield action, "passes"
        else:
            yield intervention.action, f"{intervention.reason} {intervention.first}"


EPISODES: dict[str, tuple[Any, LeftTurnConfig | None, int]] = {
    "random": (random_pedal, None, 8),
    "expert": (expert_pedal, None, 6),
    "guided": (guided_pedal, None, 8),
    "queue": (guided_pedal, QUEUE, 4),
}
"""Name -> who drives, the scenario, how many episodes."""


def numbers(*values: float) -> bytes:
    """Values to 1e-9; the sum takes the sign off a zero."""
    return " ".join(repr(round(float(value), 9) + 0.0) for value in values).encode()


def digest(name: str) -> str:
    drive, config, episodes = EPISODES[name]
    env, digest = LeftTurnEnv(config), hashlib.sha256()
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        pedal, ended = drive(env, seed), False
        while not ended:
            action, remark = next(pedal)
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
