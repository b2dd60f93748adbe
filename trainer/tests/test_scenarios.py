"""What holds for every scenario."""

import hashlib
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from trainer.drivers import ACTIONS, make_environment
from trainer.scenarios import SCENARIOS

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


@every_scenario
def test_gymnasiums_checker_passes(scenario):
    check_env(gymnasium.make(SCENARIOS[scenario]).unwrapped, skip_render_check=True)


@every_scenario
def test_stable_baselines3s_checker_passes(scenario):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_for_sb3(gymnasium.make(SCENARIOS[scenario]).unwrapped, warn=False)


DIGEST = """
import hashlib, numpy as np, sys
from trainer.drivers import make_environment
digest = hashlib.sha256()
for condition in ("nominal", "variant"):
    env, random = make_environment(sys.argv[1], condition), np.random.default_rng(5)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        ended = False
        while not ended:
            action = random.uniform(-1, 1, 1).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            digest.update(observation.tobytes() + repr((reward, info)).encode())
print(digest.hexdigest())
"""


@every_scenario
def test_the_same_seed_gives_the_same_episode_in_any_process(scenario):
    command = [sys.executable, "-c", DIGEST, scenario]
    runs = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)
    ]
    assert len(runs[0].strip()) == hashlib.sha256().digest_size * 2
    assert runs[0] == runs[1]


@every_scenario
def test_a_policy_and_its_environment_name_the_same_actions(scenario):
    """What the bridge compares when a policy comes to drive."""
    assert make_environment(scenario).action_names == (ACTIONS[scenario].name,)


@every_scenario
def test_seeds_differ(scenario):
    env = make_environment(scenario)
    first, _ = env.reset(seed=1)
    second, _ = env.reset(seed=2)
    assert not np.array_equal(first, second)


@every_scenario
def test_an_observation_is_a_picture_that_moves(scenario):
    env = make_environment(scenario)
    start, _ = env.reset(seed=0)
    assert len(np.unique(start)) > 4
    assert np.array_equal(start[0], start[1])
    moved, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.array_equal(moved[0], start[1])
    assert not np.array_equal(moved[0], moved[1])


def start_of(env):
    return env.ego.position.tolist(), [(car.speed, *car.position) for car in env.traffic]


@every_scenario
def test_standing_changes_the_ego_cars_speed_and_nothing_else(scenario):
    env = make_environment(scenario)
    moving, _ = env.reset(seed=4)
    speed_mps, start = env.ego.speed, start_of(env)
    standing, info = env.reset(seed=4, options={"standing": True})
    assert speed_mps > 0.0
    assert info["speed_mps"] == 0.0
    assert start_of(env) == start
    assert np.array_equal(standing, moving)
    env.reset(seed=4)
    assert env.ego.speed == speed_mps
