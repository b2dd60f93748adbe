"""From the policy's action to a vehicle's speed and wheel angle, within its limits."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.tests.rigs import CARS, CONGESTION, LEFT_TURN, SPEC
from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.mapping import SPECS, SetPoint, Wish, similarity_to, wish_of

MOST = SPEC.max_speed_mps
unit = st.floats(-1, 1)


def test_steering_by_hand():
    """Full left (-1): slip atan(tan(0.15) / 2), and a circle of 2.5 m / sin(slip), a quarter."""
    for share in (1.0, 0.7):
        radius_m = 2.5 / math.sin(math.atan(0.5 * math.tan(0.15 * share)))
        assert CONGESTION.car.curvature(-share) == pytest.approx(1 / radius_m)
        assert math.tan(CONGESTION.centre_rad(-share)) == pytest.approx(0.650 / (0.25 * radius_m))
        assert CONGESTION.centre_rad(share) < 0 == CONGESTION.centre_rad(0.0)
    # A circle of 2 m radius at the rear axle's middle (Ackermann): the inner wheel's is 1.6975 m.
    centre = math.atan(0.650 / 2.0)
    assert SPEC.inner_rad(centre) == pytest.approx(math.atan(0.650 / (2.0 - 0.3025)))
    assert SPEC.inner_rad(-centre) == -SPEC.inner_rad(centre)


def pedal_to_speed(speed_mps, pedal, measured=None):
    set_point = SetPoint(LEFT_TURN)
    set_point.speed_mps = speed_mps
    set_point.follow(Wish(pedal, None, None), 0.1, speed_mps if measured is None else measured)
    return set_point.speed_mps


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
    assert speed == pytest.approx(0.75 * mapping.LEAD_S)
    assert pedal_to_speed(0.0, 0.5, measured=1.0) == pytest.approx(1.0 - 0.375)
    assert pedal_to_speed(0.0, -0.5, measured=1.0) == 0.0  # a brake that does not bite


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(unit)
def test_all_the_way_from_the_action_to_the_inner_wheel_and_back(spec, share):
    inner = share * spec.max_inner_steering_rad
    centre = spec.centre_rad(inner)
    assert abs(centre) <= abs(inner) + 1e-12
    assert spec.inner_rad(centre) == pytest.approx(inner, abs=1e-9)
    assert abs(spec.inner_rad(3 * share / 2)) <= spec.max_inner_steering_rad + 1e-9  # never too far
    similarity = similarity_to(CARS["congestion"], spec)
    inner = spec.inner_rad(similarity.centre_rad(share))
    assert similarity.steering(spec.centre_rad(inner)) == pytest.approx(share, abs=1e-9)
    assert inner == 0 or (inner < 0) == (share > 0)  # its action +1 turns right


@pytest.mark.parametrize(("scale", "reach"), [(0.25, 1.0), (0.02, 0.511)])
def test_no_steering_is_asked_for_that_the_wheels_do_not_reach(scale, reach):
    limit = similarity_to(CARS["congestion"], SPEC, scale).limits()["steering"]
    assert (-limit.low, limit.high) == pytest.approx((reach, reach), abs=1e-3)
    if reach < 1.0:  # From stop to stop at the wheels' own rate
        way_s = 2 * SPEC.max_inner_steering_rad / SPEC.max_steering_rate_radps
        assert 2 * limit.high / limit.slew_per_s == pytest.approx(way_s)


PEDALS, SPEEDS_MPS = st.floats(-3, 3), st.floats(-2, 2)


@given(st.lists(st.tuples(PEDALS, PEDALS, st.floats(-0.1, 0.3), SPEEDS_MPS), max_size=40))
def test_a_set_point_stays_within_the_limits_and_turns_no_faster_than_its_rate(steps):
    set_point = SetPoint(CONGESTION)
    full_rad = SPEC.inner_rad(CONGESTION.centre_rad(-1.0))
    for pedal, steering, step_s, measured_mps in steps:
        before_rad = set_point.inner_rad
        wish = wish_of({"pedal": pedal, "steering": steering}, None)
        set_point.follow(wish, step_s, measured_mps)
        most_rad = SPEC.max_steering_rate_radps * min(max(step_s, 0.0), 0.1)
        assert abs(set_point.inner_rad - before_rad) <= most_rad + 1e-12
        assert abs(set_point.inner_rad) <= full_rad + 1e-12
        assert 0.0 <= set_point.speed_mps <= MOST
