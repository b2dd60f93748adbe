"""What holds for every scenario: spaces, test conditions, traffic, the board's table of cars."""

import copy
import itertools
import json
import math

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from bridge.environments import CONDITIONS as SERVED
from edge_runtime.vehicles.mapping import CARS
from trainer.__main__ import main
from trainer.drivers import ACTIONS, CONDITIONS, EXPERTS, make_environment
from trainer.evaluate import drive_episodes
from trainer.scenarios import SCENARIOS
from trainer.scenarios.congestion import CongestionConfig
from trainer.scenarios.environment import EgoVehicle
from trainer.scenarios.left_turn import LeftTurnConfig
from trainer.scenarios.picture import overlap
from trainer.scenarios.traffic import CAR, CARS_ONLY, MIXED, draw_types, idm_acceleration
from trainer.tests.humans import episode

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


@pytest.mark.parametrize(
    ("scenario", "condition", "drives", "arriving"),
    [
        ("left_turn", "nominal", 60, 60),
        ("left_turn", "variant", 25, 24),
        ("left_turn", "dense", 25, 24),
        ("congestion", "nominal", 20, 20),
        ("congestion", "noise", 20, 20),
        ("congestion", "variant", 25, 24),
        ("congestion", "dense", 25, 24),
    ],
)
def test_the_expert_arrives(scenario, condition, drives, arriving):
    env = make_environment(scenario, condition)
    results = drive_episodes(env, EXPERTS[scenario](env), range(drives), condition)
    assert sum(result.outcome == "goal" for result in results) >= arriving


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
@pytest.mark.parametrize("condition", NAMES)
def test_cars_never_touch_each_other(scenario, condition):
    env = make_environment(scenario, condition)
    expert = EXPERTS[scenario](env)
    for seed in range(6):
        expert.reset()
        for _ in episode(env, expert, seed):
            shapes = [car.footprint for car in env.traffic]
            assert not any(overlap(a, b) for a, b in itertools.combinations(shapes, 2))
            fastest_mps = 6.01 if condition != "dense" else 7.01
            assert all(0.0 <= car.speed <= fastest_mps for car in env.traffic)


@pytest.mark.parametrize(("scenario", "cars"), [("left_turn", 3), ("congestion", 8)])
def test_render_shows_road_cars_and_frames(scenario, cars):
    env = make_environment(scenario)
    env.reset(seed=0)
    picture = env.render()
    assert (picture.dtype, picture.shape[2]) == (np.uint8, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    assert [v["ego"] for v in env.scene()["vehicles"]] == [True] + cars * [False]


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


TURN, JAM = LeftTurnConfig(), CongestionConfig()
NUMBERS = {
    "left_turn": (
        TURN.throttle_mps2, TURN.brake_mps2, TURN.max_speed_mps, EgoVehicle.MAX_STEERING_RAD
    ),
    # Its +1 turns right.
    "congestion": (
        CAR.acceleration_mps2, JAM.brake_mps2, JAM.desired_speed_mps, -JAM.lambda_rad
    ),
}  # fmt: skip


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_has_its_car_as_long_as_highway_envs(scenario):
    car = CARS[scenario]
    numbers = (car.throttle_mps2, car.brake_mps2, car.max_speed_mps, car.full_steering_rad)
    assert numbers == NUMBERS[scenario]
    assert car.wheelbase_m == EgoVehicle.LENGTH == Vehicle.LENGTH


def test_the_curvature_is_the_bicycles_own():
    """One step of highway-env's model: heading gained over way covered."""
    action = 0.5
    ego = EgoVehicle(None, (0.0, 0.0), 0.0, 4.0)
    ego.drive(0.0, action * CongestionConfig().lambda_rad, 6.0, 0.1)
    left_rad = -ego.heading  # its y axis points down: positive turns right
    way_m = math.hypot(*ego.position)
    assert way_m == pytest.approx(0.4)
    curvature = CARS["congestion"].curvature(action)
    assert left_rad / way_m == pytest.approx(curvature)


def by_highway_env(car, dt_s):
    """Acceleration, place, heading and speed after a step of highway-env's own methods."""
    twin = copy.copy(car)
    twin.position = car.position.copy()
    wanted = IDMVehicle.acceleration(twin, twin, twin.leader)
    wanted = float(min(max(wanted, -car.ACC_MAX), car.ACC_MAX))
    twin.action = {"steering": 0.0, "acceleration": max(wanted, -car.speed / dt_s)}
    Vehicle.step(twin, dt_s)
    return wanted, twin.position.tolist(), float(twin.heading), float(twin.speed)


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
@pytest.mark.parametrize("condition", ["nominal", "variant"])
def test_cars_move_to_the_bit_as_highway_envs_idm_vehicles(scenario, condition):
    env, random = make_environment(scenario, condition), np.random.default_rng(0)
    dt_s = env.config.control_period_s
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(40):
            # Speeds, gaps and headings of the ego car, a leader too, that no episode would bring.
            car = env.traffic[random.integers(len(env.traffic))]
            car.speed = float(random.uniform(0.0, 12.0))
            car.position[0] += random.uniform(-1.0, 1.0)
            env.ego.heading = float(random.uniform(-0.3, 0.3))
            for car in env.traffic:
                expected = by_highway_env(car, dt_s)
                start = car.position.copy(), car.speed
                car.act()
                acceleration = car.action["acceleration"]
                car.step(dt_s)
                moved = car.position.tolist(), float(car.heading), car.speed
                assert (acceleration, *moved) == expected
                car.position[:], car.speed = start
            env.step(np.zeros(1, np.float32))


def test_whoever_brakes_to_a_stop_stands():
    env = make_environment("congestion")
    env.reset(seed=0)
    car = env.traffic[0]
    car.speed, car.action = 0.2, {"steering": 0.0, "acceleration": -6.0}
    car.step(0.1)
    assert car.speed == 0.0


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
