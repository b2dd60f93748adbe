"""The vehicles of the traffic: their types, the IDM, and that they move as highway-env's do."""

import copy
import math

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from trainer.drivers import make_environment
from trainer.scenarios.traffic import CAR, MIXED, draw_types, idm_acceleration


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
