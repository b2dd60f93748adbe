from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.errors import UserError
from edge_runtime.vehicles.similarity import CARS, car_of, similarity_to

CONGESTION = similarity_to(CARS["congestion"], 1.5)


def test_speeds_of_the_left_turn_on_the_hunter_by_hand():
    similarity = similarity_to(car_of("left_turn", "hunter"), max_speed_mps=1.5)
    assert similarity.scale == 0.25
    assert similarity.vehicle_mps(6.0) == 1.5
    assert similarity.scenario_mps(0.5) == 2.0


def test_curvature_by_hand():
    """Full left (-1): slip atan(tan(0.15) / 2), and a circle of 2.5 m / sin(slip), a quarter."""
    radius_m = 2.5 / math.sin(math.atan(0.5 * math.tan(0.15)))
    assert CONGESTION.vehicle_curvature(-1.0) == pytest.approx(1 / (0.25 * radius_m))
    assert CONGESTION.vehicle_curvature(1.0) < 0 == CONGESTION.vehicle_curvature(0.0)


@pytest.mark.parametrize("scenario", CARS)
@given(steering=st.floats(-1, 1), scale=st.floats(0.01, 2.0))
def test_steering_there_and_back(scenario, steering, scale):
    similarity = similarity_to(CARS[scenario], 1.5, scale)
    assert similarity.scale == scale
    curvature = similarity.vehicle_curvature(steering)
    assert similarity.steering(curvature) == pytest.approx(steering, abs=1e-9)


@given(curvature=st.floats(-1e6, 1e6))
def test_no_curvature_is_too_much_for_the_inverse(curvature):
    assert math.isfinite(CONGESTION.steering(curvature))


def test_an_unknown_scenario_is_one_line_that_says_what_to_set():
    with pytest.raises(UserError, match=r"'parking'.*congestion, left_turn.*\[similarity.car\]"):
        car_of("parking", "hunter")
