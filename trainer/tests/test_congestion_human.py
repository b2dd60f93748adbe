import math
from dataclasses import replace

import numpy as np
import pytest

from trainer.human.congestion import CongestionExpert, CongestionTrigger
from trainer.scenarios.congestion import CongestionConfig, CongestionEnv
from trainer.scenarios.traffic import CAR
from trainer.tests.test_congestion import CENTRED, LEFT, RIGHT, STRAIGHT

ALONE = replace(CENTRED, side_cars=1, side_front_m=(60.0, 60.0))


def environment(
    offset_m: float = 0.0, heading_rad: float = 0.0, config: CongestionConfig = CENTRED
) -> CongestionEnv:
    start, course = (offset_m, offset_m), (heading_rad, heading_rad)
    env = CongestionEnv(replace(config, start_offset_m=start, start_heading_rad=course))
    env.reset(seed=0)
    return env


def test_the_expert_steers_back_and_then_straight():
    for offset_m, sign in ((0.3, -1.0), (-0.3, 1.0)):
        env = environment(offset_m)
        expert = CongestionExpert(env)
        assert expert.act(env.frames)[0] * sign > 0.3
        for _ in range(80):
            env.step(expert.act(env.frames))
        assert abs(env.ego.position[1]) < 0.05
        assert abs(env.ego.heading) < 0.01


def test_the_expert_seeks_the_middle_of_the_gap():
    env = environment(config=replace(CENTRED, traffic_mix=((CAR, 1.0),)))
    expert = CongestionExpert(env)
    assert expert.middle_m() == pytest.approx(0.0)
    for car in env.traffic:
        if car.position[1] < -2.0:
            car.position[1] += 0.4
    assert expert.middle_m() == pytest.approx(0.2)
    assert expert.act(env.frames)[0] > 0.0


def judge(env: CongestionEnv, action: np.ndarray) -> str | None:
    return CongestionTrigger(CongestionExpert(env)).judge(action)


def test_turning_aside_is_taken_over():
    assert judge(environment(heading_rad=0.11), LEFT) is None
    assert judge(environment(heading_rad=0.14), LEFT) == "heading"
    assert judge(environment(heading_rad=-0.14), RIGHT) == "heading"


def test_an_offset_is_taken_over_even_where_the_road_is_free():
    assert judge(environment(0.7, config=ALONE), STRAIGHT) is None
    assert judge(environment(0.9, config=ALONE), STRAIGHT) == "offset"
    assert judge(environment(-0.9, config=ALONE), STRAIGHT) == "offset"
    # Steered back in time it is no matter.
    assert judge(environment(0.9, config=ALONE), LEFT) is None
    assert judge(environment(-0.9, config=ALONE), RIGHT) is None


def test_a_drift_that_nobody_steers_against_is_taken_over():
    for side, back, onwards in ((1.0, LEFT, RIGHT), (-1.0, RIGHT, LEFT)):
        drifting = environment(0.1 * side, 0.06 * side, ALONE)
        assert judge(drifting, STRAIGHT) == "offset"
        assert judge(drifting, onwards) == "offset"
        assert judge(drifting, back) is None
        assert judge(environment(0.1 * side, -0.06 * side, ALONE), onwards) is None


def test_on_the_way_back_to_the_middle_nobody_is_taken_over():
    for offset_m in (0.2, 0.45, 0.7):
        env = environment(offset_m, -0.08, replace(ALONE, ego_speed_mps=(6.0, 6.0)))
        trigger = CongestionTrigger(CongestionExpert(env))
        for _ in range(40):
            action = trigger.expert.act(env.frames)
            assert trigger.judge(action) is None
            env.step(action)


def test_a_side_that_will_touch_is_taken_over():
    assert judge(environment(0.75, 0.1), RIGHT) == "collision"
    assert judge(environment(-0.75, 0.1), STRAIGHT) is None


class OnlyCollisions(CongestionTrigger):
    """Objects to nothing but cars that would be hit."""

    HEADING_RAD = OFFSET_M = math.inf


@pytest.mark.parametrize("kind", [CongestionTrigger, OnlyCollisions])
def test_every_crash_is_foreseen_in_its_last_second(kind):
    env, random = CongestionEnv(), np.random.default_rng(1)
    trigger = kind(CongestionExpert(env))
    crashes = 0
    for seed in range(25):
        env.reset(seed=seed)
        info: dict = {}
        objected: list[bool] = []
        while "outcome" not in info:
            action = random.uniform(-1, 1, 1).astype(np.float32)
            objected.append(trigger.judge(action) is not None)
            *_, info = env.step(action)
        if info["outcome"] == "collision":
            crashes += 1
            assert any(objected[-round(trigger.HORIZON_S / env.config.control_period_s) :])
    assert crashes > 10
