from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.errors import UserError
from edge_runtime.limiter import limit_action, limit_rows, neutral_action, stop_action
from edge_runtime.tests.policies import PEDAL, STEERING
from edge_runtime.vehicles.interface import ActionLimit
from edge_runtime.vehicles.mock import MockVehicle

SLOW = {"pedal": ActionLimit(-1.0, 0.5, slew_per_s=2.0)}
units = st.floats(-1, 1)


@given(st.floats(-3, 3), units)
def test_without_a_vehicle_only_the_manifest_bounds(wanted, last):
    rows = limit_rows([PEDAL], {})
    assert limit_action([wanted], [last], rows) == [min(max(wanted, -1.0), 1.0)]


@given(units, units)
def test_the_mock_lets_every_action_through_unchanged(wanted, last):
    rows = limit_rows([PEDAL], MockVehicle.limits)
    assert limit_action([wanted], [last], rows) == [wanted]


@given(st.floats(-3, 3), st.floats(-1, 0.5))
def test_a_slow_vehicle_moves_at_most_its_step(wanted, last):
    (limited,) = limit_action([wanted], [last], limit_rows([PEDAL], SLOW))
    assert abs(limited - last) <= 0.2 + 1e-12
    assert -1.0 <= limited <= 0.5


def test_by_hand():
    rows = limit_rows([PEDAL], SLOW)
    assert limit_action([1.0], [0.0], rows) == [0.2]
    assert limit_action([-1.0], [0.0], rows) == [-0.2]
    assert limit_action([1.0], [0.4], rows) == [0.5]


def test_a_stop_is_full_brake_at_once_and_holds_the_steering():
    rows = limit_rows([PEDAL, STEERING], {})
    assert stop_action([0.7, 0.3], rows) == [-1.0, 0.3]
    assert neutral_action(rows) == [0.0, 0.0]


def test_a_vehicle_without_the_policys_action_is_refused():
    with pytest.raises(UserError, match="no 'steering'"):
        limit_rows([STEERING], SLOW)
    with pytest.raises(UserError, match="do not meet"):
        limit_rows([PEDAL], {"pedal": ActionLimit(2.0, 3.0, 1.0)})
