import itertools
from dataclasses import replace

import numpy as np
import pytest

import trainer.scenarios  # noqa: F401 (registers the environments)
from trainer.drivers import make_environment
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv
from trainer.tests.humans import BRAKE, FULL, NOTHING, drive

EMPTY_ROAD = LeftTurnConfig(traffic_cars=0)


def test_on_an_empty_road_full_throttle_reaches_the_goal():
    env = LeftTurnEnv(EMPTY_ROAD)
    rewards, info = drive(env, FULL)
    assert info["outcome"] == "goal"
    assert info["distance_m"] == pytest.approx(21.0, abs=0.65)
    assert rewards[-1] == pytest.approx(10.0 - 0.02 * 1.0)


def test_the_tracker_keeps_the_car_on_its_path_at_every_speed():
    for speed_mps in (2.0, 4.0, 6.0):
        env = LeftTurnEnv(replace(EMPTY_ROAD, ego_speed_mps=(speed_mps, speed_mps)))
        env.reset(seed=0)
        offsets, ended = [], False
        while not ended:
            pedal = np.clip(speed_mps - env.ego.speed, -1, 1)
            _, _, terminated, truncated, _ = env.step(np.array([pedal], np.float32))
            offsets.append(abs(env.path.project(*env.ego.position)[1]))
            ended = terminated or truncated
        assert max(offsets) < 0.2


def test_the_brake_stops_the_car_and_does_not_reverse_it():
    env = LeftTurnEnv(EMPTY_ROAD)
    rewards, info = drive(env, BRAKE)
    assert info["outcome"] == "timeout"
    assert info["speed_mps"] == 0.0
    assert info["distance_m"] < 3.5
    # Eq. 31 with its scale: standing costs 0.02 x |0 - 5| a step.
    assert rewards[-1] == pytest.approx(-0.1)
    assert len(rewards) == env.config.max_steps


def test_the_printed_reward_is_eq_31_without_a_weight():
    config = replace(EMPTY_ROAD, max_steps=50)
    own, info = drive(LeftTurnEnv(config), BRAKE)
    printed, _ = drive(LeftTurnEnv(config.with_printed_reward()), BRAKE)
    assert info["outcome"] == "timeout"
    assert printed == pytest.approx(np.array(own) / config.speed_weight)
    assert make_environment("left_turn", printed_reward=True).config.speed_weight == 1.0


def test_a_crash_is_a_failure():
    env = LeftTurnEnv(LeftTurnConfig(first_car_m=(9.0, 9.0), ego_speed_mps=(4.0, 4.0)))
    rewards, info = drive(env, FULL)
    assert info["outcome"] == "collision"
    assert rewards[-1] < -9.9


def test_traffic_does_not_yield():
    env = LeftTurnEnv()
    paths = []
    for action in (FULL, BRAKE):
        env.reset(seed=7)
        for _ in range(20):
            env.step(action)
        paths.append([tuple(car.position) for car in env.traffic])
    assert paths[0] == paths[1]


def test_traffic_keeps_its_speed_range_and_does_not_collide_with_itself():
    env = LeftTurnEnv()
    for seed in range(30):
        env.reset(seed=seed)
        for _ in range(60):
            env.step(BRAKE)
            x = [car.position[0] for car in env.traffic]
            assert all(a - b > 5.0 for a, b in itertools.pairwise(x))
            assert all(0.0 <= car.speed <= 6.01 for car in env.traffic)


def test_always_driving_on_is_no_solution():
    env = LeftTurnEnv()
    successes = sum(drive(env, FULL, seed)[1]["outcome"] == "goal" for seed in range(60))
    assert successes < 20


def test_accelerations_are_those_of_the_motion():
    env = LeftTurnEnv(EMPTY_ROAD)
    env.reset(seed=0)
    before_mps = env.ego.speed
    *_, info = env.step(BRAKE)
    assert info["longitudinal_acceleration_mps2"] == pytest.approx(
        (info["speed_mps"] - before_mps) / 0.1
    )
    for _ in range(5):
        *_, info = env.step(NOTHING)
    assert info["longitudinal_acceleration_mps2"] == pytest.approx(0.0, abs=1e-9)


def test_render_shows_road_cars_and_frames():
    env = LeftTurnEnv(render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    scene = env.scene()
    assert [v["ego"] for v in scene["vehicles"]] == [True, False, False, False]


def test_the_pedal_for_a_speed_gives_the_car_that_speed():
    env = LeftTurnEnv(EMPTY_ROAD)
    env.reset(seed=0, options={"standing": True})
    for speed_mps in (0.1, 0.4, 0.7, 0.55, 0.2, 0.2, 0.0):
        env.step(np.array([env.pedal_for_speed(speed_mps)], np.float32))
        assert env.ego.speed == pytest.approx(speed_mps, abs=1e-6)


def test_a_speed_out_of_reach_is_made_up_for_later():
    env = LeftTurnEnv(EMPTY_ROAD)
    env.reset(seed=0, options={"standing": True})
    assert env.pedal_for_speed(1.0) == 1.0  # 0.3 m/s a step is all that the engine gives
    for _ in range(4):
        env.step(np.array([env.pedal_for_speed(1.0)], np.float32))
    assert env.ego.speed == pytest.approx(1.0, abs=1e-6)
    assert env.pedal_for_speed(0.0) == -1.0
