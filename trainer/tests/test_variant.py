"""The variant scenes of both scenarios, and the vehicle types in them."""

import itertools
import json
import math

import numpy as np
import pytest

from trainer.__main__ import main
from trainer.drivers import EXPERTS, make_environment
from trainer.evaluate import drive_episodes
from trainer.scenarios.traffic import CAR, CARS_ONLY, MIXED, draw_types, idm_acceleration

SCENARIOS = ("left_turn", "congestion")


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_variant_has_more_vehicles_and_every_type(scenario):
    nominal, variant = make_environment(scenario), make_environment(scenario, "variant")
    usual, seen = set(), set()
    for seed in range(20):
        nominal.reset(seed=seed)
        variant.reset(seed=seed)
        assert len(variant.traffic) > len(nominal.traffic)
        usual |= {(car.LENGTH, car.WIDTH) for car in nominal.traffic}
        seen |= {(car.LENGTH, car.WIDTH) for car in variant.traffic}
    assert usual == {(kind.length_m, kind.width_m) for kind, _ in CARS_ONLY}
    assert seen == {(kind.length_m, kind.width_m) for kind, _ in MIXED}


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_noise_is_the_nominal_scene(scenario):
    nominal, noise = make_environment(scenario), make_environment(scenario, "noise")
    assert noise.config == nominal.config
    assert np.array_equal(nominal.reset(seed=1)[0], noise.reset(seed=1)[0])


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_expert_drives_the_variant(scenario):
    env = make_environment(scenario, "variant")
    results = drive_episodes(env, EXPERTS[scenario](env), range(25), "variant")
    assert sum(result.outcome == "goal" for result in results) >= 24


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_vehicles_do_not_start_inside_each_other(scenario):
    env = make_environment(scenario, "variant")
    for seed in range(30):
        env.reset(seed=seed)
        cars = sorted(env.traffic, key=lambda car: (car.lane_index, car.position[0]))
        for behind, ahead in itertools.pairwise(cars):
            if behind.lane_index == ahead.lane_index:
                room_m = ahead.position[0] - behind.position[0]
                assert room_m - 0.5 * (ahead.LENGTH + behind.LENGTH) > 3.0


def test_types_accelerate_as_they_are():
    env = make_environment("congestion", "variant")
    for seed in range(10):
        env.reset(seed=seed)
        for car in env.traffic:
            (kind,) = (kind for kind, _ in MIXED if kind.length_m == car.LENGTH)
            car.speed, car.target_speed, car.leader = 0.0, 6.0, None
            car.act()
            assert car.action["acceleration"] == pytest.approx(kind.acceleration_mps2)


def test_shares_of_the_mix_and_no_draw_for_one_type():
    random = np.random.default_rng(0)
    before = random.bit_generator.state
    assert draw_types(((CAR, 1.0),), 3, random) == [CAR] * 3
    assert random.bit_generator.state == before
    drawn = draw_types(MIXED, 4000, random)
    for kind, share in MIXED:
        assert drawn.count(kind) / 4000 == pytest.approx(share, abs=0.03)
    assert sum(share for _, share in MIXED) == pytest.approx(1.0)


def test_idm_by_hand():
    # Free road at half the desired speed: 3 x (1 - 1/16).
    assert idm_acceleration(CAR, 3.0, 6.0) == pytest.approx(2.8125)
    assert idm_acceleration(CAR, 6.0, 6.0) == pytest.approx(0.0)
    # Standing 2 m behind a standing car: the free road's pull and the gap's push are equal.
    assert idm_acceleration(CAR, 0.0, 6.0, gap_m=2.0) == pytest.approx(0.0)
    # 5 m/s, 1 m/s faster, 10 m behind: wanted 2 + 5 x 0.8 + 5 / (2 sqrt 15) m.
    wanted_m = 6.0 + 5.0 / (2.0 * math.sqrt(15.0))
    expected = 3.0 * (1.0 - (5.0 / 6.0) ** 4 - (wanted_m / 10.0) ** 2)
    assert idm_acceleration(CAR, 5.0, 6.0, 10.0, 1.0) == pytest.approx(expected)
    half = 3.0 * (1.0 - (5.0 / 6.0) ** 4 - 0.16)
    assert idm_acceleration(CAR, 5.0, 6.0, 10.0, 0.0, 0.5) == pytest.approx(half)
    # A leader that pulls away asks for no less than the room at rest.
    assert idm_acceleration(CAR, 1.0, 6.0, 2.0, -50.0) == pytest.approx(-3.0 / 6.0**4)


def test_evaluate_takes_the_condition(tmp_path):
    out = tmp_path / "r.json"
    arguments = ["evaluate", "expert", "--scenario", "congestion", "--condition", "variant"]
    assert main([*arguments, "--runs", "2", "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert (report["scenario"], report["condition"]) == ("congestion", "variant")
    assert report["success_rate"] == 1.0
    assert report["surviving_distance_m"]["mean"] == pytest.approx(80.2, abs=0.4)
