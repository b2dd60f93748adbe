"""The board's table of cars is that of the scenarios, which it cannot import."""

import math

import pytest
from highway_env.vehicle.kinematics import Vehicle

from edge_runtime.vehicles.mapping import CARS
from trainer.scenarios import SCENARIOS
from trainer.scenarios.congestion import CongestionConfig
from trainer.scenarios.environment import EgoVehicle
from trainer.scenarios.left_turn import LeftTurnConfig
from trainer.scenarios.traffic import CAR

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
