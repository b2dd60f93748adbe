"""The board's table of cars is that of the scenarios, which it cannot import."""

import math

import pytest
from highway_env.vehicle.kinematics import Vehicle

from edge_runtime.vehicles.mapping import CARS
from trainer.scenarios import SCENARIOS
from trainer.scenarios.congestion import CongestionConfig
from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.left_turn import LeftTurnConfig
from trainer.scenarios.traffic import CAR


def test_the_left_turns_car():
    config, car = LeftTurnConfig(), CARS["left_turn"]
    assert car.throttle_mps2 == config.throttle_mps2
    assert car.brake_mps2 == config.brake_mps2
    assert car.max_speed_mps == config.max_speed_mps
    assert car.full_steering_rad == EgoVehicle.MAX_STEERING_RAD


def test_the_congestions_car():
    config, car = CongestionConfig(), CARS["congestion"]
    assert car.throttle_mps2 == CAR.acceleration_mps2
    assert car.brake_mps2 == config.brake_mps2
    assert car.max_speed_mps == config.desired_speed_mps
    assert car.full_steering_rad == -config.lambda_rad  # its +1 turns right


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_has_its_car_as_long_as_highway_envs(scenario):
    assert CARS[scenario].wheelbase_m == EgoVehicle.LENGTH == Vehicle.LENGTH


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
