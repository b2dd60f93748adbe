"""What holds for every scenario."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from trainer.drivers import ACTIONS, make_environment
from trainer.scenarios import SCENARIOS

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


@every_scenario
def test_gymnasiums_and_stable_baselines3s_checkers_pass(scenario):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_env(gymnasium.make(SCENARIOS[scenario]).unwrapped, skip_render_check=True)
    check_for_sb3(gymnasium.make(SCENARIOS[scenario]).unwrapped, warn=False)


@every_scenario
def test_a_policy_and_its_environment_name_the_same_actions(scenario):
    """What the bridge compares when a policy comes to drive."""
    assert make_environment(scenario).action_names == (ACTIONS[scenario].name,)


@every_scenario
def test_an_observation_is_a_picture_that_moves(scenario):
    env = make_environment(scenario)
    other, _ = env.reset(seed=1)
    start, _ = env.reset(seed=0)
    assert not np.array_equal(start, other)
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
