from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.vehicles.interface import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle
from edge_runtime.vehicles.watch import DEVIATES_S, LYING, SILENCE_S, SILENT, STUCK, VehicleWatch

TICK_S = 0.05


def report(pedal=0.0, speed_mps=1.0, self_braking=False):
    return VehicleReport({"pedal": pedal}, speed_mps, self_braking, [])


def watched(seconds=1.0, asked=0.0, **reported):
    """A watch that has seen a steady drive; and the time."""
    watch, now_s = VehicleWatch(), 100.0
    watch.begin(now_s)
    for tick in range(round(seconds / TICK_S)):
        now_s = 100.0 + tick * TICK_S
        watch.command({"pedal": asked}, now_s)
        watch.report(report(**reported), now_s)
    return watch, now_s


def test_nothing_is_wrong_with_a_vehicle_that_obeys():
    watch, now_s = watched(asked=0.3, pedal=0.3)
    assert watch.fault(now_s) == ""


def test_a_vehicle_that_was_not_begun_owes_nothing():
    assert VehicleWatch().fault(1e9) == ""


def test_silence_after_two_periods_also_before_the_first_report():
    watch = VehicleWatch()
    watch.begin(10.0)
    assert watch.fault(10.0 + SILENCE_S) == ""
    assert watch.fault(10.001 + SILENCE_S) == SILENT
    watch.report(report(), 10.3)
    assert watch.fault(10.3) == ""
    assert watch.silent_at_s == pytest.approx(10.3 + SILENCE_S)


def test_an_actuator_outside_of_all_that_was_asked_is_stuck_only_after_a_while():
    watch, now_s = watched(asked=0.6, pedal=0.6)
    watch.report(report(pedal=-1.0), now_s + TICK_S)
    assert watch.fault(now_s + TICK_S + DEVIATES_S) == ""
    assert watch.fault(now_s + TICK_S + DEVIATES_S + 0.001) == STUCK
    watch.report(report(pedal=0.6), now_s + 2 * TICK_S)
    assert watch.fault(now_s + 2 * TICK_S) == ""


def test_an_actuator_on_its_way_between_two_commands_is_not_stuck():
    watch, now_s = watched(asked=-1.0, pedal=-1.0)
    watch.command({"pedal": 1.0}, now_s)
    for tick in range(1, 6):
        watch.report(report(pedal=-1.0 + tick * 0.4), now_s + tick * TICK_S)
        assert watch.fault(now_s + tick * TICK_S) == ""


def test_a_vehicle_that_brakes_by_itself_obeys_nobody_and_is_not_stuck():
    watch, now_s = watched(asked=0.6, pedal=-1.0, self_braking=True)
    assert watch.fault(now_s) == ""


@pytest.mark.parametrize(
    "impossible",
    [
        report(speed_mps=9.0),
        report(speed_mps=math.nan),
        report(pedal=1.1),
        report(pedal=math.inf),
    ],
)
def test_what_cannot_be_is_a_lie(impossible):
    watch, now_s = watched()
    watch.report(impossible, now_s + TICK_S)
    assert watch.fault(now_s + TICK_S) == LYING


def test_a_leap_is_a_lie_until_that_speed_could_be_real():
    watch, now_s = watched(speed_mps=1.0)
    watch.report(report(speed_mps=5.0), now_s + 0.2)  # 0.5 m/s and 15 m/s2 for 0.2 s: up to 4.5
    assert watch.fault(now_s + 0.2) == LYING
    watch.report(report(speed_mps=5.0), now_s + 0.3)  # up to 6.0
    assert watch.fault(now_s + 0.3) == ""


@settings(deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=1, max_size=30))
def test_the_mock_is_never_accused(pedals):
    """Whatever a policy asks at the control rate, reported at the feedback's."""
    vehicle, watch = MockVehicle(), VehicleWatch()
    vehicle.enable(0.0)
    watch.begin(0.0)
    for step, pedal in enumerate(pedals):
        for offset_s in (0.0, TICK_S):
            now_s = step * 0.1 + offset_s
            if offset_s == 0.0:
                vehicle.command({"pedal": pedal}, now_s)
                watch.command({"pedal": pedal, "steering": 0.0}, now_s)
            watch.report(vehicle.feedback(now_s), now_s)
            assert watch.fault(now_s) == ""
