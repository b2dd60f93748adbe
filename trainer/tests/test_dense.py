"""The dense scenes of both scenarios: a fourth test condition, which nobody trains in."""

import itertools

import numpy as np
import pytest

from bridge.environments import CONDITIONS as SERVED
from trainer.drivers import CONDITIONS, EXPERTS, make_environment
from trainer.evaluate import drive_episodes
from trainer.scenarios.picture import overlap
from trainer.scenarios.traffic import CAR

every_scenario = pytest.mark.parametrize("scenario", ["left_turn", "congestion"])


def gaps_m(env):
    """Bumper to bumper, of each two vehicles one behind the other in a lane without the ego car."""
    others = [car for car in env.traffic if abs(car.position[1]) > 1.0]
    cars = sorted(others, key=lambda car: (car.lane_index, car.position[0]))
    return [
        ahead.position[0] - behind.position[0] - 0.5 * (ahead.LENGTH + behind.LENGTH)
        for behind, ahead in itertools.pairwise(cars)
        if behind.lane_index == ahead.lane_index
    ]


@every_scenario
def test_the_expert_drives_it(scenario):
    env = make_environment(scenario, "dense")
    results = drive_episodes(env, EXPERTS[scenario](env), range(25), "dense")
    assert sum(result.outcome == "goal" for result in results) >= 24


@every_scenario
def test_there_are_more_cars_than_in_training_and_no_other_ones(scenario):
    nominal, dense = make_environment(scenario), make_environment(scenario, "dense")
    assert dense.config.traffic_mix == nominal.config.traffic_mix
    for seed in range(10):
        nominal.reset(seed=seed)
        dense.reset(seed=seed)
        assert len(dense.traffic) > len(nominal.traffic)


@every_scenario
def test_cars_never_touch_each_other(scenario):
    env = make_environment(scenario, "dense")
    expert = EXPERTS[scenario](env)
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        expert.reset()
        ended = False
        while not ended:
            observation, _, terminated, truncated, _ = env.step(expert.act(observation))
            ended = terminated or truncated
            shapes = [car.footprint for car in env.traffic]
            assert not any(overlap(a, b) for a, b in itertools.combinations(shapes, 2))


def test_the_gaps_of_the_left_turn_are_of_one_range_most_of_them_near_the_limit():
    env, gaps = make_environment("left_turn", "dense"), []
    for seed in range(200):
        env.reset(seed=seed)
        gaps += [gap + CAR.length_m for gap in gaps_m(env)]
    counts, _ = np.histogram(gaps, bins=8, range=(12.0, 28.0))
    assert counts.sum() == len(gaps) == 200 * 5
    assert counts.min() > 0.7 * counts.mean()
    assert 0.5 < np.mean([16.0 < gap < 25.0 for gap in gaps]) < 0.62


def test_the_jam_is_closer_and_less_even():
    spread, nearest = {}, {}
    for condition in ("nominal", "dense"):
        env, gaps, room = make_environment("congestion", condition), [], []
        for seed in range(30):
            env.reset(seed=seed)
            gaps += gaps_m(env)
            room += [abs(car.position[1]) - 0.5 * car.WIDTH for car in env.traffic]
        spread[condition] = np.std(gaps)
        nearest[condition] = min(m for m in room if m > 0.0) - 0.5 * env.ego.WIDTH
    assert spread["dense"] > 2.0 * spread["nominal"]
    assert nearest["nominal"] == pytest.approx(1.25, abs=0.1)
    assert nearest["dense"] == pytest.approx(0.5, abs=0.1)


def test_every_scene_can_be_served():
    assert set(SERVED) == {condition.scene for condition in CONDITIONS.values()}
