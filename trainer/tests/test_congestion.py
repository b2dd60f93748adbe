import math
from dataclasses import replace

import numpy as np
import pytest

import trainer.scenarios  # noqa: F401 (registers the environments)
from trainer.environments import make_environment
from trainer.human.congestion import CongestionHuman
from trainer.person.tests.people import drive
from trainer.scenarios.base import footprint
from trainer.scenarios.congestion import CongestionConfig, CongestionEnv
from trainer.scenarios.picture import corners

STRAIGHT, RIGHT, LEFT = (np.array([steering], np.float32) for steering in (0.0, 1.0, -1.0))
CENTRED = CongestionConfig(
    start_offset_m=(0.0, 0.0), start_heading_rad=(0.0, 0.0), lane_offset_m=(0.0, 0.0)
)


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
    for _ in range(2):
        env.reset(seed=0)
        assert env.brake_action == pytest.approx([0.0])
        rewards = [env.step(np.array([a], np.float32))[1] for a in (0.0, 0.5, 0.5, -0.25, 3.0)]
        # Eq. 32 with the sign that discourages: -0.1 |change|, from straight wheels, clipped to 1.
        assert rewards == pytest.approx([0.0, -0.05, 0.0, -0.075, -0.125])
    printed = make_environment("congestion", printed_reward=True)  # eq. 32 without a weight
    printed.reset(seed=0)
    assert [printed.step(action)[1] for action in (STRAIGHT, 0.5 * LEFT)] == [0.0, -0.5]
    env.step(np.array([0.4], np.float32))
    assert (env.brake_action.dtype, env.brake_action) == (np.float32, pytest.approx([0.4]))


@pytest.mark.parametrize(
    ("changes", "steering", "outcome", "reward"),
    [
        ({}, 0.3, "collision", -10.0),
        ({"side_cars": 1, "side_front_m": (60.0, 60.0)}, -1.0, "off_road", -10.0),
        ({"max_steps": 20}, 0.0, "timeout", 0.0),
    ],
)
def test_touching_a_car_or_leaving_the_road_fails_and_time_runs_out(
    changes, steering, outcome, reward
):
    env = CongestionEnv(replace(CENTRED, **changes))
    rewards, info = drive(env, np.array([steering], np.float32))
    assert (info["outcome"], rewards[-1]) == (outcome, reward)
    sides_m = corners(footprint(env.ego))[:, 1]
    assert (sides_m.min() < -5.25) == (outcome == "off_road")
    assert (env.ego.position[1] > 0.5) == (outcome == "collision")


def test_the_brake_stops_the_car_and_no_one_behind_runs_into_it():
    env = CongestionEnv(replace(CENTRED, cars_behind=2, side_cars=4))
    for seed in range(10):
        env.reset(seed=seed)
        speeds_mps = []
        for step in range(55):
            env.press_brake(5 <= step < 35)
            *_, info = env.step(STRAIGHT)
            assert step >= 35 or "outcome" not in info
            speeds_mps.append(info["speed_mps"])
        assert speeds_mps[34] == 0.0
        assert speeds_mps[54] > 2.0


ALONE = replace(CENTRED, side_cars=1, side_front_m=(60.0, 60.0))


def environment(
    offset_m: float = 0.0, heading_rad: float = 0.0, config: CongestionConfig = CENTRED
) -> CongestionEnv:
    start, course = (offset_m, offset_m), (heading_rad, heading_rad)
    env = CongestionEnv(replace(config, start_offset_m=start, start_heading_rad=course))
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("offset_m", "heading_rad", "action", "reason"),
    [
        # Even where the road is free; steered back in time it is no matter.
        (1.0, 0.0, STRAIGHT, None),
        (1.2, 0.0, STRAIGHT, "offset"),
        (1.2, -0.12, LEFT, None),
        (0.9, 0.12, STRAIGHT, "offset"),
        (0.6, 0.12, STRAIGHT, None),
        # A heading, whatever is done.
        (0.0, 0.18, LEFT, None),
        (0.0, 0.22, LEFT, "heading"),
    ],
)
def test_who_turns_or_is_aside_is_taken_over(side, offset_m, heading_rad, action, reason):
    trigger = CongestionHuman(environment(side * offset_m, side * heading_rad, ALONE))
    assert trigger.wants_control(side * action) == reason
