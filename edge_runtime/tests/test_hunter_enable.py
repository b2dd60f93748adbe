"""The Hunter's driver in made-up time: how it is enabled, and what is known of it then."""

from __future__ import annotations

import math

import pytest

from edge_runtime.tests.hunter_bench import (
    OK,
    Bench,
    sent_ids,
)
from edge_runtime.vehicles.hunter import core as rules
from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.states import Event, State


def test_nothing_leaves_before_enable():
    bench = Bench()
    bench.core.brake(bench.now_s)
    bench.step(100, {"pedal": 1.0})
    assert bench.sent == []
    assert bench.core.close(bench.now_s) == []


def test_the_enable_sequence_and_its_confirmation():
    bench = Bench()
    bench.status = OK._replace(mode=frames.STANDBY, brake=1)
    bench.core.enable(bench.now_s)
    bench.step()
    assert [(part.frame.can_id, part.data) for _, part in bench.sent] == [
        (0x421, b"\x01"),
        (0x131, b"\x00"),
        (0x111, bytes(8)),
    ]
    bench.step(20, {"pedal": 1.0})
    assert bench.core.state is State.ENABLING
    assert sent_ids(bench).count(0x421) == 5  # each 0.1 s until it is confirmed
    bench.status = OK
    bench.step(6, {"pedal": 1.0})
    assert bench.core.state is State.ENABLED
    count = sent_ids(bench).count(0x421)
    bench.step(50, {"pedal": 1.0})
    assert sent_ids(bench).count(0x421) == count
    assert bench.speed_mps == pytest.approx(0.75, abs=0.1)


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (None, "the chassis sends no 0x221"),
        (OK._replace(mode=frames.STANDBY), "the chassis is in standby, not under CAN control"),
        (OK._replace(mode=7), "the chassis is in mode 7, not under CAN control"),
        (OK._replace(brake=1), "the chassis has locked its brake"),
        (OK._replace(faults=1), "battery undervoltage"),
        (OK._replace(state=2), "the chassis is in state 2 (exception)"),
    ],
)
def test_a_chassis_that_does_not_confirm(status, words):
    bench = Bench()
    bench.status, bench.hears = status, status is not None
    bench.core.enable(bench.now_s)
    bench.step(48, {"pedal": 1.0})
    assert bench.core.state is State.ENABLING
    bench.step(5, {"pedal": 1.0})
    assert bench.core.state is State.STOPPED
    assert bench.words[0] == f"not enabled within 1 s: {words}"
    assert set(bench.motions()) == {(0.0, 0.0)}


def test_a_new_core_knows_nothing():
    core = Bench().core
    assert (core.state, core.cause, core.words) == (State.DISABLED, None, "")
    report = core.report(0.0)
    assert (report.faults, report.speed_mps, report.battery_v) == ([], 0.0, None)
    assert report.action == {"pedal": -1.0, "steering": 0.0}
    assert report.self_braking
    assert core.standing(0.0) == ["the chassis sends no 0x221"]
    assert core.late_at_s == math.inf


def test_errors_are_cleared_before_control_is_asked_for():
    bench = Bench()
    bench.tell(frames.SYSTEM_STATUS, OK._replace(faults=1))
    bench.core.enable(bench.now_s)
    bench.step()
    assert [(part.frame.can_id, part.data) for _, part in bench.sent] == [
        (0x441, b"\x00"),
        (0x421, b"\x01"),
        (0x131, b"\x00"),
        (0x111, bytes(8)),
    ]


def test_a_chassis_that_stands_has_its_brake_on_unless_it_is_asked_to_go():
    bench = Bench().enabled()
    assert bench.core.report(bench.now_s).action["pedal"] == -1.0
    bench.obeys = False
    bench.step(20, {"pedal": 1.0})
    assert bench.core.report(bench.now_s).action["pedal"] == 0.0
    bench.core.brake(bench.now_s, latch=False)
    bench.step()
    assert bench.core.report(bench.now_s).action["pedal"] == -1.0


def test_time_limits_to_the_instant():
    bench = Bench().driving()
    core = bench.core
    core._wished_s, core._since_s = 0.0, -1.0
    now_s = rules.COMMAND_TIMEOUT_S
    for at_s, state in ((now_s, State.ENABLED), (now_s + 1e-9, State.STOPPED)):
        core.reports.motion_s = core.reports.status_s = at_s
        core.tick(at_s)
        assert core.state is state
    core.state = State.ENABLED
    for at_s, state in (
        (0.0, State.ENABLED),
        (rules.BUS_PATIENCE_S, State.ENABLED),
        (rules.BUS_PATIENCE_S + 1e-9, State.STOPPED),
    ):
        core.bus_failed("full", at_s)
        assert core.state is state
    core.state, core._since_s = State.ENABLING, 0.0
    core.tick(rules.ENABLE_TIMEOUT_S)
    assert core.state is State.ENABLING
    core.tick(rules.ENABLE_TIMEOUT_S + 1e-9)
    assert core.state is State.STOPPED


def test_what_is_at_rest():
    bench = Bench()
    assert bench.core.is_at_rest(bench.now_s)  # never enabled
    bench.driving()
    assert not bench.core.is_at_rest(bench.now_s)
    bench.status = OK._replace(mode=frames.REMOTE_CONTROL)
    bench.step(6)
    bench.speed_mps, bench.obeys = 1.0, False
    bench.step(6)
    assert bench.core.is_at_rest(bench.now_s)  # a person has it
    bench.status = OK
    bench.step(6)
    assert not bench.core.is_at_rest(bench.now_s)
    bench.core.bus_failed("bus-off", bench.now_s, fatal=True)
    assert bench.core.is_at_rest(bench.now_s)  # nothing reaches it
    bench.core.bus_works()
    bench.speed_mps = 0.0
    bench.step(1)
    assert bench.core.is_at_rest(bench.now_s)
    assert not bench.core.is_at_rest(bench.now_s + 1.0)  # that was then


@pytest.mark.parametrize("age_s", [0.0, 0.3])
def test_a_status_from_before_confirms_nothing(age_s):
    bench = Bench()
    bench.tell(frames.SYSTEM_STATUS, OK)
    bench.now_s += age_s
    bench.core.enable(bench.now_s)
    bench.tell(frames.REAR_LEFT_SLOW, frames.MotorSlow(24.0, 30, 30, 0))
    assert bench.core.state is State.ENABLING
    bench.now_s += 0.05
    bench.tell(frames.REAR_LEFT_SLOW, frames.MotorSlow(24.0, 30, 30, 0))
    assert bench.core.state is State.ENABLING
    bench.tell(frames.SYSTEM_STATUS, OK)
    assert bench.core.state is State.ENABLED


def test_to_enable_it_again_gives_it_the_whole_time_again():
    bench = Bench()
    bench.hears = False
    bench.core.enable(bench.now_s)
    bench.step(45)
    bench.core.enable(bench.now_s)
    bench.step(45)
    assert bench.core.state is State.ENABLING


def test_to_enable_it_while_it_drives_makes_it_stand_until_the_next_command():
    bench = Bench().driving()
    bench.core.enable(bench.now_s)
    count = len(bench.sent)
    bench.step(6)
    assert bench.core.state is State.ENABLED
    assert set(bench.motions(count)) == {(0.0, 0.0)}


def test_a_vehicle_that_was_stuck_has_a_new_chance_to_follow():
    bench = Bench().driving(1.0)
    bench.obeys, bench.speed_mps = False, 0.7
    bench.step(130, {"pedal": -1.0})
    assert bench.core.cause is Event.STUCK
    bench.enabled().step(40, {"pedal": -1.0})
    assert bench.core.state is State.ENABLED
    bench.step(30, {"pedal": -1.0})
    assert bench.core.cause is Event.STUCK


def test_errors_are_cleared_when_it_is_enabled_but_a_lost_link_is_not():
    for faults, clears in ((0x0001, True), (0x1000, False), (0, False)):
        bench = Bench()
        bench.status = OK._replace(faults=faults)
        bench.core.enable(bench.now_s)
        bench.step(12)
        assert (0x441 in sent_ids(bench)) == clears
