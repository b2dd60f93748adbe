from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.config import Config, SimilaritySettings
from edge_runtime.tests.rigs import CAR, PEDAL
from edge_runtime.util import UserError
from edge_runtime.vehicles import make_vehicle, vehicle_limits
from edge_runtime.vehicles.mapping import CARS
from edge_runtime.vehicles.mock import MockParameters, MockVehicle


def enabled(**parameters):
    vehicle = MockVehicle(MockParameters(**parameters))
    vehicle.enable(0.0)
    return vehicle


def test_first_order_lag_by_hand():
    """From full brake to full throttle in one time constant; and the speed, 5 ms by 5 ms."""
    vehicle = enabled(dead_time_s=0.0, time_constant_s=0.1, slew_per_s=1e9)
    vehicle.command({"pedal": 1.0, "steering": 1.0}, 0.0)
    after = vehicle.feedback(0.1)
    assert after.action["pedal"] == pytest.approx(1 - 2 * math.exp(-1))
    assert after.action["steering"] == pytest.approx(1 - math.exp(-1))
    pedals = [1 - 2 * math.exp(-0.05 * step) for step in range(1, 21)]
    assert after.speed_mps == pytest.approx(sum(max(0.0, 3.0 * pedal) for pedal in pedals) * 0.005)


@pytest.mark.parametrize("scenario", [*CARS, "another"])
def test_it_is_no_quicker_than_the_policys_car(scenario):
    car = CARS.get(scenario, CARS["left_turn"])
    vehicle = make_vehicle("mock", Config(), scenario)
    vehicle.enable(0.0)
    speeds = []
    for tick in range(400):
        vehicle.command({"pedal": 1.0 if tick < 300 else -1.0}, tick * 0.1)
        speeds.append(vehicle.feedback(tick * 0.1).speed_mps)
    assert max(speeds) == car.max_speed_mps
    changes = [(after - before) / 0.1 for before, after in zip(speeds, speeds[1:])]
    assert max(changes) == pytest.approx(car.throttle_mps2, rel=0.01)
    assert min(changes) == pytest.approx(-car.brake_mps2, rel=0.01)


def test_a_car_of_the_settings_is_its_car():
    config = Config(similarity=SimilaritySettings(car=CAR))
    vehicle = make_vehicle("mock", config, "left_turn")
    vehicle.enable(0.0)
    for tick in range(100):
        vehicle.command(PEDAL, tick * 0.1)
    assert vehicle.feedback(10.0).speed_mps == 0.5


def test_the_rate_limit_by_hand():
    vehicle = enabled(dead_time_s=0.0, time_constant_s=1e-9, slew_per_s=2.0)
    vehicle.command(PEDAL, 0.0)
    assert vehicle.feedback(0.1).action["pedal"] == pytest.approx(-1.0 + 0.2)


def test_it_follows_commands_and_brakes_by_itself_without_them():
    vehicle = enabled()
    for step in range(20):
        vehicle.command({"pedal": 1.0, "steering": 0.5}, step * 0.1)
    driving = vehicle.feedback(1.95)
    assert not driving.self_braking
    assert driving.speed_mps > 5.0
    assert driving.action["steering"] == pytest.approx(0.5, abs=1e-3)
    assert not vehicle.feedback(1.9 + 0.2).self_braking
    left_alone = vehicle.feedback(1.9 + 0.21)
    assert left_alone.self_braking
    stopped = vehicle.feedback(10.0)
    assert stopped.speed_mps == 0.0
    assert stopped.action["pedal"] == pytest.approx(-1.0)
    assert stopped.action["steering"] == pytest.approx(0.5, abs=1e-3)


def test_the_dead_time_passes_before_anything_moves_and_a_brake_overtakes_it():
    for brakes in (False, True):
        vehicle = enabled(dead_time_s=0.1)
        vehicle.command(PEDAL, 0.0)
        if brakes:
            vehicle.brake(0.05)
        assert vehicle.feedback(0.09).action["pedal"] == -1.0
        assert (vehicle.feedback(0.19).action["pedal"] > -1.0) != brakes
        assert vehicle.feedback(1e6).speed_mps == 0.0  # a long gap is no long computation


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(0.001, 0.5)), max_size=20))
def test_it_stays_within_its_limits(commands):
    vehicle, now_s = enabled(), 0.0
    for pedal, pause_s in commands:
        vehicle.command({"pedal": pedal}, now_s)
        now_s += pause_s
        report = vehicle.feedback(now_s)
        assert -1.0 - 1e-9 <= report.action["pedal"] <= 1.0 + 1e-9
        assert 0.0 <= report.speed_mps <= MockParameters().max_speed_mps


def test_the_registry():
    assert isinstance(make_vehicle("mock", Config(), ""), MockVehicle)
    assert vehicle_limits("none", Config(), "") == {}
    assert vehicle_limits("mock", Config(), "") == MockVehicle.limits
    for make in (make_vehicle, vehicle_limits):
        with pytest.raises(UserError, match=r"choose from .*mock, hunter"):
            make("tank", Config(), "")


def test_it_moves_only_enabled_and_a_stop_latches_but_at_an_episodes_end():
    vehicle = MockVehicle()
    vehicle.command(PEDAL, 0.0)
    assert vehicle.feedback(0.2).speed_mps == 0.0
    vehicle.enable(0.2)
    vehicle.brake(0.2)
    vehicle.command(PEDAL, 0.3)
    assert vehicle.feedback(0.5).speed_mps == 0.0
    vehicle.enable(0.5)
    vehicle.command(PEDAL, 0.5)
    assert vehicle.feedback(0.7).speed_mps > 0.0
    vehicle.brake(0.7, latch=False)
    assert vehicle.feedback(5.0).speed_mps == 0.0
    vehicle.command(PEDAL, 5.0)
    assert vehicle.feedback(5.2).speed_mps > 0.0


def test_a_command_without_an_action_is_refused():
    with pytest.raises(ValueError, match="lacks an action"):
        enabled().command({}, 0.1, 6.0)
