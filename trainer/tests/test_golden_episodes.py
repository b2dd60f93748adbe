"""Whole episodes, pinned: whoever makes a scenario faster must not change it.

A digest covers pictures to the bit and numbers to 1e-9: far more than another libm changes, far
less than another model does. `python -m trainer.tests.test_golden_episodes` prints new digests.
"""

import hashlib
from typing import Any

import numpy as np
import pytest

from trainer.environments import make_environment
from trainer.human.guide import HumanGuide
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv

QUEUE = LeftTurnConfig(traffic_cars=8, first_car_m=(-30.0, 12.0), short_gap_m=(7.0, 9.0))
"""A longer queue than usual, closely packed: the followers brake."""


def random_driver(env, seed):
    """A restless action that favours one side: in the left turn the throttle."""
    random = np.random.default_rng(seed)
    while True:
        yield random.uniform(-0.6, 1.0, 1).astype(np.float32), ""


def expert_driver(env, seed):
    expert = env.expert()
    while True:
        yield expert.act(env.frames), ""


def guided_driver(env, seed):
    """A policy that drives on, then one that stands still, under the guide's eyes."""
    expert = env.expert()
    guide = HumanGuide(expert, env.expert())
    for action, _ in random_driver(env, seed):
        wanted = -np.abs(action) if seed % 2 else action
        taken = guide.watch(env.frames, wanted)
        yield (taken.action, f"{taken.reason} {taken.first}") if taken else (wanted, "passes")


EPISODES: list[tuple[Any, ...]] = [
    ("99a651c9237ffb06", random_driver, 8, LeftTurnEnv),
    ("3f816926ad56a5b6", expert_driver, 6, LeftTurnEnv),
    ("0f2bcfc8346c08a9", guided_driver, 8, LeftTurnEnv),
    ("c252a806eb914614", guided_driver, 4, LeftTurnEnv, QUEUE),
    ("33f19cff22bc9157", expert_driver, 4, make_environment, "left_turn", "variant"),
    ("b446e260c41008d3", random_driver, 6, make_environment, "congestion"),
    ("4654583381419aa3", expert_driver, 2, make_environment, "congestion"),
    ("9ced478a7e3e511b", expert_driver, 2, make_environment, "congestion", "variant"),
    ("321961c59e49aa7b", expert_driver, 4, make_environment, "left_turn", "dense"),
    ("26ec6b10e5023e4e", expert_driver, 2, make_environment, "congestion", "dense"),
]
"""What the digest begins with; who drives, in how many episodes, in which environment."""


def numbers(*values: float) -> bytes:
    """Values to 1e-9; the sum takes the sign off a zero."""
    return " ".join(repr(round(float(value), 9) + 0.0) for value in values).encode()


def digest(drive, episodes, make, *arguments):
    env, digest = make(*arguments), hashlib.sha256()
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        for action, remark in drive(env, seed):
            observation, reward, terminated, truncated, info = env.step(action)
            digest.update(observation.tobytes() + remark.encode())
            digest.update(str(info.pop("outcome", "")).encode())
            digest.update(numbers(*action, reward, *info.values()))
            for car in env.scene()["vehicles"]:
                digest.update(numbers(car["x"], car["y"], car["heading_rad"], car["speed_mps"]))
            if terminated or truncated:
                break
    return digest.hexdigest()


@pytest.mark.parametrize("row", EPISODES, ids=lambda row: row[0])
def test_episodes_are_what_they_were(row):
    golden, *episodes = row
    assert digest(*episodes).startswith(golden)


if __name__ == "__main__":
    for _, *drives in EPISODES:
        print(digest(*drives)[:16], *drives[2:])
