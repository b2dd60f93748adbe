import math
from dataclasses import replace

import numpy as np
import pytest

import trainer.scenarios  # noqa: F401 (registers the environments)
from trainer.drivers import make_environment
from trainer.scenarios.congestion import CongestionConfig, CongestionEnv
from trainer.scenarios.picture import corners, overlap

STRAIGHT, RIGHT, LEFT = (np.array([steering], np.float32) for steering in (0.0, 1.0, -1.0))
CENTRED = CongestionConfig(
    start_offset_m=(0.0, 0.0), start_heading_rad=(0.0, 0.0), lane_offset_m=(0.0, 0.0)
)


def drive(env: CongestionEnv, action: np.ndarray, seed: int = 0) -> tuple[list[float], dict]:
    env.reset(seed=seed)
    rewards = []
    while True:
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        assert terminated == (info.get("outcome") in ("goal", "collision", "off_road"))
        if terminated or truncated:
            return rewards, info


def test_eight_cars_within_20_m_and_the_ego_car_between_them():
    env = CongestionEnv()
    for seed in range(30):
        env.reset(seed=seed)
        assert len(env.traffic) == 8
        x, y = np.array([car.position for car in env.traffic]).T
        assert np.abs(x).max() < 20.0
        assert (y < -2.0).sum() == (y > 2.0).sum() == 3
        assert all(4.0 <= car.speed <= 6.0 for car in env.traffic)
        assert 4.0 <= env.ego.speed <= 6.0


def test_traffic_never_touches_itself_in_either_scene():
    for scene in ("nominal", "variant"):
        env = CongestionEnv(scene=scene)
        for seed in range(8):
            drive(env, STRAIGHT, seed)
            shapes = [car.footprint for car in env.traffic]
            pairs = [(a, b) for i, a in enumerate(shapes) for b in shapes[:i]]
            assert not any(overlap(a, b) for a, b in pairs)
            assert all(0.0 <= car.speed <= 6.01 for car in env.traffic)


def test_straight_from_mid_lane_reaches_the_goal_behind_the_car_ahead():
    env = CongestionEnv(CENTRED)
    rewards, info = drive(env, STRAIGHT)
    assert info["outcome"] == "goal"
    assert info["distance_m"] == pytest.approx(80.0, abs=0.61)
    assert rewards[:-1] == [0.0] * (len(rewards) - 1)
    assert rewards[-1] == 10.0
    leader, follower = (car for car in env.traffic if car.lane_index[2] == 1)
    assert follower.position[0] < env.ego.position[0]
    gap_m = leader.position[0] - env.ego.position[0] - 2.5 - 0.5 * leader.LENGTH
    assert 2.0 < gap_m < 12.0
    assert env.ego.speed == pytest.approx(leader.speed, abs=0.3)


def test_the_printed_reward_is_eq_32_without_a_weight():
    env = make_environment("congestion", printed_reward=True)
    env.reset(seed=0)
    assert [env.step(action)[1] for action in (STRAIGHT, 0.5 * LEFT, 0.5 * LEFT)] == [0, -0.5, 0]


def test_zero_steering_succeeds_in_less_than_half_and_random_rarely():
    env, random = CongestionEnv(), np.random.default_rng(0)
    straight = sum(drive(env, STRAIGHT, seed)[1]["outcome"] == "goal" for seed in range(40))
    assert 8 <= straight <= 20
    wandering = 0
    for seed in range(20):
        env.reset(seed=seed)
        info: dict = {}
        while "outcome" not in info:
            *_, info = env.step(random.uniform(-1, 1, 1).astype(np.float32))
        wandering += info["outcome"] == "goal"
    assert wandering <= 5


@pytest.mark.parametrize(("action", "sign"), [(RIGHT, 1.0), (LEFT, -1.0)])
def test_negative_steers_left_and_full_action_is_lambda(action, sign):
    env = CongestionEnv(CENTRED)
    env.reset(seed=0)
    speed_mps = env.ego.speed
    *_, info = env.step(action)
    # Kinematic bicycle: the rear half of 5 m, the slip angle half of the wheels'.
    slip_rad = math.atan(0.5 * math.tan(0.15))
    assert env.ego.heading == pytest.approx(sign * speed_mps * math.sin(slip_rad) / 2.5 * 0.1)
    assert info["lateral_acceleration_mps2"] * sign > 0.5
    env.step(action)
    # y grows downwards, to the right of a car that drives along x.
    assert env.ego.position[1] * sign > 0.0


def test_changing_the_steering_costs_and_holding_it_does_not():
    env = CongestionEnv(CENTRED)
    env.reset(seed=0)
    commands = [0.5, 0.5, -0.25, 3.0]
    rewards = [env.step(np.array([a], np.float32))[1] for a in commands]
    # Eq. 32 with the sign that discourages: -0.1 |change|, from straight wheels, clipped to 1.
    assert rewards == pytest.approx([-0.05, 0.0, -0.075, -0.125])
    env.reset(seed=0)
    assert env.step(STRAIGHT)[1] == 0.0


def test_a_car_beside_is_a_collision_and_fails():
    env = CongestionEnv(CENTRED)
    rewards, info = drive(env, np.array([0.3], np.float32))
    assert info["outcome"] == "collision"
    assert rewards[-1] == -10.0
    assert env.ego.position[1] > 0.5


def test_leaving_the_road_fails():
    env = CongestionEnv(replace(CENTRED, side_cars=1, side_front_m=(60.0, 60.0)))
    rewards, info = drive(env, LEFT)
    assert info["outcome"] == "off_road"
    assert rewards[-1] == -10.0
    assert corners(env.ego.footprint)[:, 1].min() < -5.25


def test_time_runs_out_without_a_terminal():
    env = CongestionEnv(replace(CENTRED, max_steps=20))
    env.reset(seed=0)
    for _ in range(19):
        _, _, terminated, truncated, _ = env.step(STRAIGHT)
        assert not terminated
        assert not truncated
    _, reward, terminated, truncated, info = env.step(STRAIGHT)
    assert (terminated, truncated, info["outcome"], reward) == (False, True, "timeout", 0.0)


def test_the_ego_car_follows_whoever_is_in_its_corridor():
    env = CongestionEnv(CENTRED)
    env.reset(seed=0)
    ahead, behind = (car for car in env.traffic if car.lane_index[2] == 1)
    assert env._leader() is ahead
    assert behind.leader is env.ego
    env.ego.position[1] = 2.0
    beside = env._leader()
    assert beside is not None
    assert beside.lane_index[2] == 2
    env.ego.position[:] = (50.0, 0.0)
    assert env._leader() is None


def test_the_brake_stops_the_car_and_no_one_behind_runs_into_it():
    env = CongestionEnv(replace(CENTRED, cars_behind=2, side_cars=4))
    for seed in range(10):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(STRAIGHT)
        env.press_brake(True)
        for _ in range(30):
            *_, info = env.step(env.brake_action)
            assert "outcome" not in info
        assert info["speed_mps"] == 0.0
        env.press_brake(False)
        for _ in range(20):
            *_, info = env.step(STRAIGHT)
        assert info["speed_mps"] > 2.0


@pytest.mark.parametrize("condition", ["nominal", "variant"])
def test_nobody_behind_a_car_that_stays_standing_drives_backwards(condition):
    env = make_environment("congestion", condition)
    for seed in range(4):
        env.reset(seed=seed)
        env.press_brake(True)
        for _ in range(120):
            *_, terminated, truncated, _ = env.step(env.brake_action)
            assert min(car.speed for car in env.traffic) > -1e-9
            if terminated or truncated:
                break


def test_the_brake_action_is_the_last_steering():
    env = CongestionEnv(CENTRED)
    env.reset(seed=0)
    env.step(np.array([0.4], np.float32))
    assert env.brake_action.dtype == np.float32
    assert env.brake_action == pytest.approx([0.4])
    env.reset(seed=0)
    assert env.brake_action == pytest.approx([0.0])
