"""The test conditions beside the nominal one: variant and dense scenes, and noise."""

import itertools
import json

import numpy as np
import pytest

from bridge.environments import CONDITIONS as SERVED
from trainer.__main__ import main
from trainer.drivers import CONDITIONS, EXPERTS, make_environment
from trainer.evaluate import drive_episodes
from trainer.scenarios.picture import overlap
from trainer.scenarios.traffic import CAR, CARS_ONLY, MIXED

every_scenario = pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
NAMES = ("nominal", "variant", "dense")


def gaps_m(env, of_the_ego_lane=False):
    """Bumper to bumper, of each two vehicles one behind the other in a lane."""
    others = [car for car in env.traffic if of_the_ego_lane or abs(car.position[1]) > 1.0]
    cars = sorted(others, key=lambda car: (car.lane_index, car.position[0]))
    return [
        ahead.position[0] - behind.position[0] - 0.5 * (ahead.LENGTH + behind.LENGTH)
        for behind, ahead in itertools.pairwise(cars)
        if behind.lane_index == ahead.lane_index
    ]


@every_scenario
@pytest.mark.parametrize("condition", ["variant", "dense"])
def test_the_expert_drives_it(scenario, condition):
    env = make_environment(scenario, condition)
    results = drive_episodes(env, EXPERTS[scenario](env), range(25), condition)
    assert sum(result.outcome == "goal" for result in results) >= 24


@every_scenario
def test_there_are_more_vehicles_of_every_type_in_the_variant_and_of_no_other_in_the_dense(
    scenario,
):
    nominal, variant, dense = (make_environment(scenario, name) for name in NAMES)
    assert dense.config.traffic_mix == nominal.config.traffic_mix
    usual, seen = set(), set()
    for seed in range(20):
        for env in (nominal, variant, dense):
            env.reset(seed=seed)
        assert len(variant.traffic) > len(nominal.traffic) < len(dense.traffic)
        usual |= {(car.LENGTH, car.WIDTH) for car in nominal.traffic}
        seen |= {(car.LENGTH, car.WIDTH) for car in variant.traffic}
    assert usual == {(kind.length_m, kind.width_m) for kind, _ in CARS_ONLY}
    assert seen == {(kind.length_m, kind.width_m) for kind, _ in MIXED}


@every_scenario
def test_noise_is_the_nominal_scene(scenario):
    nominal, noise = make_environment(scenario), make_environment(scenario, "noise")
    assert noise.config == nominal.config
    assert np.array_equal(nominal.reset(seed=1)[0], noise.reset(seed=1)[0])


@every_scenario
def test_vehicles_do_not_start_inside_each_other(scenario):
    env = make_environment(scenario, "variant")
    for seed in range(30):
        env.reset(seed=seed)
        assert min(gaps_m(env, of_the_ego_lane=True)) > 3.0


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


def test_evaluate_takes_the_condition(tmp_path):
    out = tmp_path / "r.json"
    arguments = ["evaluate", "expert", "--scenario", "congestion", "--condition", "variant"]
    assert main([*arguments, "--runs", "2", "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert (report["scenario"], report["condition"]) == ("congestion", "variant")
    assert report["success_rate"] == 1.0
    assert report["surviving_distance_m"]["mean"] == pytest.approx(80.2, abs=0.4)
