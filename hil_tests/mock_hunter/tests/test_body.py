"""The body's laws: no leap, no overshoot, no limit passed; and its geometry by hand."""

import math
from dataclasses import fields

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import SPECS
from hil_tests.mock_hunter.hunter import (
    MODELS,
    SOURCES,
    Body,
    Parameters,
    Setpoint,
    advance,
    curvature,
    make_parameters,
)

P = MODELS["hunter-2.0"]
setpoints = st.builds(Setpoint, st.floats(-3, 3), st.floats(-1, 1))
bodies = st.builds(
    Body, st.floats(-P.max_speed_mps, P.max_speed_mps), st.floats(-P.max_inner_rad, P.max_inner_rad)
)
steps_s = st.floats(0.001, 0.02)


@settings(deadline=None)  # a busy machine pauses
@given(bodies, st.one_of(st.none(), setpoints), steps_s)
def test_nothing_leaps_and_no_limit_is_passed(body, setpoint, step_s):
    after = advance(body, setpoint, step_s, P)
    assert abs(after.speed_mps) <= P.max_speed_mps + 1e-12
    assert abs(after.inner_rad) <= P.max_inner_rad + 1e-12
    fastest = max(P.acceleration_mps2, P.braking_mps2)
    assert abs(after.speed_mps - body.speed_mps) <= fastest * step_s + 1e-12
    assert abs(after.inner_rad - body.inner_rad) <= P.steering_rate_radps * step_s + 1e-12


@settings(deadline=None)  # a busy machine pauses
@given(bodies, setpoints, steps_s)
def test_speed_comes_closer_and_never_overshoots(body, setpoint, step_s):
    wanted = min(max(setpoint.speed_mps, -P.max_speed_mps), P.max_speed_mps)
    after = advance(body, setpoint, step_s, P)
    before_gap, gap = wanted - body.speed_mps, wanted - after.speed_mps
    assert abs(gap) <= abs(before_gap) + 1e-12
    assert before_gap * gap >= -1e-12


@settings(deadline=None)  # a busy machine pauses
@given(bodies, steps_s)
def test_the_brake_ends_in_a_stand_with_the_steering_held(body, step_s):
    moved = body
    for _ in range(math.ceil(P.max_speed_mps / (P.braking_mps2 * step_s)) + 1):
        moved = advance(moved, None, step_s, P)
    assert moved.speed_mps == pytest.approx(0.0, abs=1e-9)
    assert moved.inner_rad == body.inner_rad


def settle(setpoint, seconds, step_s=0.005):
    body = Body()
    for _ in range(round(seconds / step_s)):
        body = advance(body, setpoint, step_s, P)
    return body


def test_a_first_order_response_covers_63_percent_in_its_time_constant():
    small = 0.05  # below the rate limit, so that the lag alone is seen
    slow = settle(Setpoint(small), P.speed_time_constant_s)
    assert slow.speed_mps == pytest.approx(small * (1 - math.exp(-1)), rel=1e-9)


def test_the_steering_turns_at_its_rate():
    assert settle(Setpoint(0.0, 0.5), 0.3).inner_rad == pytest.approx(
        0.3 * P.steering_rate_radps, rel=1e-9
    )


def test_the_path_of_an_inner_angle_by_hand():
    """tan(0.4) = 0.42279; radius = 0.65 / 0.42279 + 0.605 / 2 = 1.83990 m."""
    assert 1 / curvature(0.4, P) == pytest.approx(1.83990, abs=1e-4)
    assert curvature(-0.4, P) == -curvature(0.4, P)
    assert curvature(0.0, P) == 0.0


def test_the_outer_wheel_covers_more_and_their_middle_the_way():
    body = settle(Setpoint(0.0, 0.4), 1.0)
    for _ in range(400):
        body = advance(body, Setpoint(1.0, 0.4), 0.005, P)
    assert body.right_m > body.left_m > 0  # a turn to the left
    radius_m = 1.83990
    half_m = P.track_m / 2
    ratio = (radius_m + half_m) / (radius_m - half_m)
    assert body.right_m / body.left_m == pytest.approx(ratio, abs=1e-4)


def test_every_number_says_where_it_comes_from():
    assert set(SOURCES) == {field.name for field in fields(Parameters)}


@pytest.mark.parametrize(("model", "name"), [("hunter-2.0", "2.0"), ("hunter-se", "se")])
def test_the_drivers_own_table_agrees(model, name):
    mine, theirs = MODELS[model], SPECS[name]
    assert mine.max_speed_mps == theirs.max_speed_mps
    assert mine.max_inner_rad == theirs.max_inner_steering_rad
    assert (mine.wheelbase_m, mine.track_m) == (theirs.wheelbase_m, theirs.track_m)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"wings": 1.0}, "no parameter 'wings'"),
        ({"track_m": 0.0}, "track_m must be above 0"),
        ({"dead_time_s": -0.1}, "dead_time_s must be above 0"),
        ({"braking_mps2": math.nan}, "braking_mps2 must be above 0"),
        ({"braking_mps2": math.inf}, "braking_mps2 must be above 0"),
    ],
)
def test_parameters_that_cannot_be_are_refused(changes, why):
    with pytest.raises(UserError, match=why):
        make_parameters("hunter-2.0", changes)
    assert make_parameters("hunter-se", {"dead_time_s": 0.0}).dead_time_s == 0.0
