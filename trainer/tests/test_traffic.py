"""The cars of the traffic move as highway-env's do, only sooner."""

import copy

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from trainer.drivers import make_environment


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
