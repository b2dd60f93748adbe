"""From the policy's action to a vehicle's speed and wheel angle, within its limits."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.tests.rigs import CONGESTION, LEFT_TURN
from edge_runtime.tests.rigs import SPEC as HUNTER
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import (
    CARS,
    LEAD_S,
    SPECS,
    SetPoint,
    car_of,
    similarity_to,
    wish_of,
)

MOST = HUNTER.max_speed_mps
unit = st.floats(-1, 1)


def test_speeds_of_the_left_turn_on_the_hunter_by_hand():
    assert similarity_to(car_of("left_turn", "hunter"), HUNTER) == LEFT_TURN
    assert LEFT_TURN.scale == 0.25
    assert LEFT_TURN.follow_speed(0.0, 4.0, 100.0) == 1.0


def test_curvature_by_hand():
    """Full left (-1): slip atan(tan(0.15) / 2), and a circle of 2.5 m / sin(slip), a quarter."""
    radius_m = 2.5 / math.sin(math.atan(0.5 * math.tan(0.15)))
    assert CONGESTION.car.curvature(-1.0) == pytest.approx(1 / radius_m)
    assert math.tan(CONGESTION.centre_rad(-1.0)) == pytest.approx(0.650 / (0.25 * radius_m))
    assert CONGESTION.centre_rad(1.0) < 0 == CONGESTION.centre_rad(0.0)


@pytest.mark.parametrize("scenario", CARS)
@given(steering=st.floats(-1, 1), scale=st.floats(0.01, 2.0))
def test_steering_there_and_back(scenario, steering, scale):
    similarity = similarity_to(CARS[scenario], HUNTER, scale)
    assert similarity.scale == scale
    centre_rad = similarity.centre_rad(steering)
    assert similarity.steering(centre_rad) == pytest.approx(steering, abs=1e-9)


@given(curvature=st.floats(-1e6, 1e6))
def test_no_curvature_is_too_much_for_the_inverse(curvature):
    assert math.isfinite(CONGESTION.car.steering(curvature))


def test_an_unknown_scenario_is_one_line_that_says_what_to_set():
    with pytest.raises(UserError, match=r"'parking'.*congestion, left_turn.*\[similarity.car\]"):
        car_of("parking", "hunter")


def pedal_to_speed(set_point, pedal, step_s=0.1, measured=None):
    measured = set_point if measured is None else measured
    return LEFT_TURN.pedal_to_speed(set_point, pedal, step_s, measured)


@pytest.mark.parametrize(
    ("speed_mps", "pedal", "after_mps"),
    [
        (0.5, 1.0, 0.5 + 0.075),  # 3 m/s2 of throttle and 4 m/s2 of brake, at a quarter, for 0.1 s
        (0.5, -0.5, 0.5 - 0.05),
        (0.5, 0.0, 0.5),
        (0.02, -1.0, 0.0),
        (1.49, 1.0, MOST),
        (MOST, -1.0, MOST - 0.1),
    ],
)
def test_pedals_by_hand(speed_mps, pedal, after_mps):
    assert pedal_to_speed(speed_mps, pedal) == pytest.approx(after_mps, abs=1e-12)


def test_a_vehicle_that_is_held_up_does_not_wind_up():
    speed = 0.0
    for _ in range(100):
        speed = pedal_to_speed(speed, 1.0, measured=0.0)
    assert speed == pytest.approx(0.75 * LEAD_S)
    assert pedal_to_speed(0.0, 0.5, measured=1.0) == pytest.approx(1.0 - 0.375)
    assert pedal_to_speed(0.0, -0.5, measured=1.0) == 0.0  # a brake that does not bite


@given(st.lists(st.tuples(unit, st.floats(0, 0.1), st.floats(-2, 2)), max_size=40))
def test_no_pedal_leaves_the_range(steps):
    speed = 0.0
    for pedal, step_s, measured in steps:
        speed = pedal_to_speed(speed, pedal, step_s, measured)
        assert 0.0 <= speed <= MOST


@given(unit)
def test_pedal_to_acceleration_and_back(pedal):
    acceleration = LEFT_TURN.acceleration_mps2(pedal)
    assert LEFT_TURN.pedal(acceleration) == pytest.approx(pedal)
    assert abs(LEFT_TURN.pedal(100 * acceleration)) <= 1.0


def test_without_a_pedal_it_follows_the_scenarios_car_within_its_accelerations():
    speed = 0.0
    for _ in range(100):
        after = CONGESTION.follow_speed(speed, 5.0, 0.02)
        assert after - speed <= 0.75 * 0.02 + 1e-12
        speed = after
    assert speed == pytest.approx(5.0 / 4)
    assert CONGESTION.follow_speed(speed, 0.0, 0.02) == pytest.approx(speed - 0.02)
    assert CONGESTION.follow_speed(MOST, 100.0, 0.1) == MOST


def test_ackermann_by_hand():
    """A circle of 2 m radius at the rear axle's middle: the inner wheel's is 1.6975 m."""
    centre = math.atan(0.650 / 2.0)
    inner = HUNTER.inner_rad(centre)
    assert inner == pytest.approx(math.atan(0.650 / (2.0 - 0.3025)))
    assert HUNTER.inner_rad(-centre) == -inner


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(share=unit)
def test_inner_to_centre_and_back(spec, share):
    inner = share * spec.max_inner_steering_rad
    centre = spec.centre_rad(inner)
    assert abs(centre) <= abs(inner) + 1e-12
    assert spec.inner_rad(centre) == pytest.approx(inner, abs=1e-9)
    assert abs(spec.inner_rad(3 * share / 2)) <= spec.max_inner_steering_rad + 1e-9  # never too far


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(steering=unit)
def test_all_the_way_from_the_action_to_the_inner_wheel_and_back(spec, steering):
    similarity = similarity_to(CARS["congestion"], spec)
    inner = spec.inner_rad(similarity.centre_rad(steering))
    assert similarity.steering(spec.centre_rad(inner)) == pytest.approx(steering, abs=1e-9)
    assert inner == 0 or (inner < 0) == (steering > 0)  # its action +1 turns right


def test_a_path_of_the_scenario_is_the_same_path_smaller():
    """The heading that a car and the robot gain on the same share of the way is the same."""
    angle = 0.15 * 0.7
    car_rad_per_m = math.sin(math.atan(0.5 * math.tan(angle))) / 2.5
    centre = CONGESTION.centre_rad(-0.7)
    robot_rad_per_m = math.tan(centre) / HUNTER.wheelbase_m
    assert robot_rad_per_m * CONGESTION.scale == pytest.approx(car_rad_per_m)


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.1, 0.3)), max_size=40))
def test_a_set_point_stays_within_the_limits_and_turns_no_faster_than_its_rate(steps):
    set_point = SetPoint(CONGESTION)
    full_rad = HUNTER.inner_rad(CONGESTION.centre_rad(-1.0))
    for pedal, steering, step_s in steps:
        before_rad = set_point.inner_rad
        set_point.follow(wish_of({"pedal": pedal, "steering": steering}, None), step_s, 1.0)
        counted_s = min(max(step_s, 0.0), 0.1)
        most_rad = HUNTER.max_steering_rate_radps * counted_s
        assert abs(set_point.inner_rad - before_rad) <= most_rad + 1e-12
        assert abs(set_point.inner_rad) <= full_rad + 1e-12
        assert 0.0 <= set_point.speed_mps <= MOST


@pytest.mark.parametrize(("asked", "taken"), [(5.0, 1.0), (-5.0, -1.0), (0.25, 0.25)])
def test_a_wish_is_within_the_actions_range(asked, taken):
    assert wish_of({"pedal": asked, "steering": -asked}, None) == (taken, None, -taken)
