from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.errors import UserError
from edge_runtime.limiter import limit_action, limit_rows, neutral_action, stop_action
from edge_runtime.tests.policies import PEDAL, STEERING
from edge_runtime.vehicles.interface import ActionLimit
from edge_runtime.vehicles.mock import MockVehicle

T = 0.1
SLOW = {"pedal": ActionLimit(-1.0, 0.5, slew_per_s=2.0)}
units = st.floats(-1, 1)
times_s = st.one_of(st.floats(0, 3), st.sampled_from([0.0, 0.005, T, 0.25, math.inf]))


@given(st.floats(-3, 3), units, times_s)
def test_without_a_vehicle_only_the_manifest_bounds(wanted, last, elapsed_s):
    rows = limit_rows([PEDAL], {})
    assert limit_action([wanted], [last], rows, elapsed_s) == [min(max(wanted, -1.0), 1.0)]


@given(units, units, times_s)
def test_the_mock_lets_every_action_through_unchanged(wanted, last, elapsed_s):
    rows = limit_rows([PEDAL], MockVehicle.limits)
    assert limit_action([wanted], [last], rows, elapsed_s) == [wanted]


@given(st.floats(-3, 3), st.floats(-1, 0.5), times_s)
def test_a_slow_vehicle_moves_at_most_its_share_of_the_time(wanted, last, elapsed_s):
    (limited,) = limit_action([wanted], [last], limit_rows([PEDAL], SLOW), elapsed_s)
    assert abs(limited - last) <= 2.0 * min(elapsed_s, T) + 1e-12
    assert -1.0 <= limited <= 0.5


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 0.3)), min_size=1, max_size=60))
def test_however_often_it_is_told_it_moves_no_faster_per_second(commands):
    rows, last, now_s = limit_rows([PEDAL], SLOW), [0.0], 0.0
    told = [(now_s, 0.0)]
    for wanted, elapsed_s in commands:
        last, now_s = limit_action([wanted], last, rows, elapsed_s), now_s + elapsed_s
        told.append((now_s, last[0]))
    for index, (then_s, then) in enumerate(told):
        for later_s, later in told[index + 1 :]:
            assert abs(later - then) <= 2.0 * (later_s - then_s) + 1e-9


def test_by_hand():
    rows = limit_rows([PEDAL], SLOW)
    assert limit_action([1.0], [0.0], rows, T) == [0.2]
    assert limit_action([-1.0], [0.0], rows, T) == [-0.2]
    assert limit_action([1.0], [0.4], rows, T) == [0.5]
    assert limit_action([1.0], [0.0], rows, 0.005) == [0.01]
    assert limit_action([1.0], [0.0], rows, 9.0) == [0.2]
    assert limit_action([1.0], [0.0], rows, -1.0) == [0.0]


def test_a_stop_is_full_brake_at_once_and_holds_the_steering():
    rows = limit_rows([PEDAL, STEERING], {})
    assert stop_action([0.7, 0.3], rows) == [-1.0, 0.3]
    assert neutral_action(rows) == [0.0, 0.0]


def test_a_vehicle_without_the_policys_action_is_refused():
    with pytest.raises(UserError, match="no 'steering'"):
        limit_rows([STEERING], SLOW)
    with pytest.raises(UserError, match="do not meet"):
        limit_rows([PEDAL], {"pedal": ActionLimit(2.0, 3.0, 1.0)})
