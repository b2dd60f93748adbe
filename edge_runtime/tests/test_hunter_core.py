"""The Hunter's driver in made-up time: how it is enabled, and what is known of it then."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import edge_runtime
from edge_runtime.tests.harness import render_table
from edge_runtime.tests.hunter_bench import OK, STREAM_S, Bench, sent_ids
from edge_runtime.vehicles import core as rules
from edge_runtime.vehicles.core import LEADS_TO, Event, Finding, State
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.core import BUS_PATIENCE_S
from edge_runtime.vehicles.mapping import wish_of


def test_nothing_leaves_before_enable():
    bench = Bench()
    bench.core.brake(bench.now_s)
    bench.step(100, {"pedal": 1.0})
    assert bench.sent == []
    assert bench.core.close(bench.now_s) == []


def test_the_enable_sequence_and_its_confirmation():
    bench = Bench()
    bench.status = OK._replace(mode=protocol.STANDBY, brake=1)
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
        (OK._replace(mode=protocol.STANDBY), "the chassis is in standby, not under CAN control"),
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
    bench.tell(protocol.SYSTEM_STATUS, OK._replace(faults=1))
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
        (BUS_PATIENCE_S, State.ENABLED),
        (BUS_PATIENCE_S + 1e-9, State.STOPPED),
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
    bench.status = OK._replace(mode=protocol.REMOTE_CONTROL)
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
    bench.tell(protocol.SYSTEM_STATUS, OK)
    bench.now_s += age_s
    bench.core.enable(bench.now_s)
    bench.tell(protocol.REAR_LEFT_SLOW, protocol.MotorSlow(24.0, 30, 30, 0))
    assert bench.core.state is State.ENABLING
    bench.now_s += 0.05
    bench.tell(protocol.REAR_LEFT_SLOW, protocol.MotorSlow(24.0, 30, 30, 0))
    assert bench.core.state is State.ENABLING
    bench.tell(protocol.SYSTEM_STATUS, OK)
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


def test_pedals_become_a_speed_and_the_speed_comes_back_as_the_scenarios():
    bench = Bench().driving(1.0)
    report = bench.core.report(bench.now_s)
    assert report.speed_mps == pytest.approx(46 * 0.75 * STREAM_S)  # its first command came late
    assert report.scenario_speed_mps == pytest.approx(4 * report.speed_mps)
    assert report.commanded_speed_mps == pytest.approx(report.speed_mps, abs=0.002)
    assert report.action["pedal"] == pytest.approx(1.0, abs=0.05)
    assert (report.faults, report.self_braking, report.battery_v) == ([], False, 24.0)
    bench.step(20, {"pedal": -0.5})
    assert bench.core.report(bench.now_s).action["pedal"] == pytest.approx(-0.5, abs=0.05)


def test_a_policy_without_a_pedal_has_the_scenarios_speed():
    bench = Bench("congestion").enabled()
    bench.step(200, {"steering": -1.0}, scenario_speed_mps=4.0)
    assert bench.speed_mps == pytest.approx(1.0)
    assert bench.inner_rad > 0.05
    assert bench.core.report(bench.now_s).action["steering"] == pytest.approx(-1.0, abs=0.02)
    bench.step(100, {"steering": 1.0}, scenario_speed_mps=0.0)
    assert bench.speed_mps == 0.0
    assert bench.inner_rad < -0.05


def test_a_brake_is_speed_zero_at_once_and_latches():
    bench = Bench().driving()
    bench.core.brake(bench.now_s)
    assert bench.core.report(bench.now_s).commanded_speed_mps == 0.0  # before the next tick, too
    count = len(bench.sent)
    bench.step(100, {"pedal": 1.0})
    assert set(bench.motions(count)) == {(0.0, 0.0)}
    assert bench.words == []  # our own wish is no fault
    assert bench.core.report(bench.now_s).self_braking
    bench.enabled().step(20, {"pedal": 1.0})
    assert bench.speed_mps > 0


def test_the_stop_at_an_episodes_end_needs_no_repetition_and_does_not_latch():
    bench = Bench().driving()
    bench.core.brake(bench.now_s, latch=False)
    count = len(bench.sent)
    bench.step(500)
    assert set(bench.motions(count)) == {(0.0, 0.0)}
    assert bench.core.state is State.ENABLED
    bench.step(20, {"pedal": 1.0})
    assert bench.speed_mps > 0


def test_without_a_fresh_command_it_stops_within_the_promise_and_latches():
    bench = Bench().driving()
    last_s = bench.core._wished_s
    assert bench.core.late_at_s == last_s + 0.24 < last_s + 0.25  # vehicle.py ticks then, too
    count = len(bench.sent)
    bench.step(100)
    assert bench.core.late_at_s == float("inf")
    stopped_s = next(time_s for time_s, told in bench.motions_at(count) if told.speed_mps == 0)
    assert 0.2 < stopped_s - last_s <= 0.25 + 0.02
    assert bench.words == ["no command for 0.24 s"]
    bench.step(50, {"pedal": 1.0})
    assert bench.speed_mps == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_command_that_is_not_finite_is_refused(value):
    bench = Bench().enabled()
    for action, speed in (({"pedal": value}, None), ({"steering": value}, 1.0), ({}, value)):
        with pytest.raises(ValueError, match="not finite"):
            bench.core.command(action, bench.now_s, speed)
    bench.step(10)
    assert bench.speed_mps == 0


@pytest.mark.parametrize(
    ("action", "speed_mps"), [({}, 6.0), ({}, None), ({"steering": 0.1}, None)]
)
def test_a_command_that_lacks_an_action_is_refused(action, speed_mps):
    """No pedal means the speed of the scenario's car only where there is a steering beside it."""
    bench = Bench().enabled()
    with pytest.raises(ValueError, match="lacks an action"):
        bench.core.command(action, bench.now_s, speed_mps)
    bench.step(10)
    assert bench.speed_mps == 0


def test_the_remote_control_keeps_its_brake_and_its_control_at_the_end():
    bench = Bench().driving()
    bench.status = OK._replace(mode=protocol.REMOTE_CONTROL)
    bench.obeys, bench.speed_mps = False, 1.0  # a person drives
    count = len(bench.sent)
    bench.step(200, {"pedal": 1.0})
    assert set(sent_ids(bench)[count + 6 :]) == {0x111}
    ends = [part.frame.can_id for part in bench.core.close(bench.now_s)]
    assert ends == [0x111, 0x421]


@pytest.mark.parametrize("brakes", [True, False])
def test_the_end_stands_parks_and_gives_control_back(brakes):
    bench = Bench().driving()
    if brakes:
        bench.core.brake(bench.now_s)
    ends = bench.core.close(bench.now_s)
    assert [(part.frame.can_id, part.data) for part in ends] == [
        (0x111, bytes(8)),
        (0x131, b"\x01"),
        (0x421, b"\x00"),
    ]
    assert bench.core.tick(bench.now_s) == []


# The rules that the table was written from, in other words.


OURS = {Event.ENABLE: State.ENABLING, Event.CLOSE: State.DISABLED}
STOP_ENABLING = {
    Event.BRAKE, Event.NOT_CONFIRMED, Event.REMOTE, Event.ESTOP, Event.BUS, Event.FOREIGN
}  # fmt: skip
STOP_DRIVING = set(Event) - set(OURS) - {Event.CONFIRMED, Event.NOT_CONFIRMED}


def expected(state, event):
    if event in OURS:
        return OURS[event]
    if state is State.ENABLING and event is Event.CONFIRMED:
        return State.ENABLED
    stops = {State.ENABLING: STOP_ENABLING, State.ENABLED: STOP_DRIVING}
    return State.STOPPED if event in stops.get(state, ()) else state


def after(state, event):
    return LEADS_TO[event].get(state, state)


def test_every_pair_of_state_and_event():
    assert {(state, event): expected(state, event) for state in State for event in Event} == {
        (state, event): LEADS_TO[event].get(state, state) for state in State for event in Event
    }


def test_the_readme_shows_the_table():
    readme = Path(edge_runtime.__file__).with_name("README.md").read_text(encoding="utf-8")
    assert render_table(Event, State, after) in readme


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("event", Event)
def test_the_core_goes_where_the_table_says(state, event):
    bench = Bench()
    core = bench.core
    core.state = state
    core.set_point.speed_mps = 1.0
    core._wish = core_wish = wish_of({"pedal": 1.0}, None)
    core._apply(Finding(event, "why"), bench.now_s)
    leads_to = after(state, event)
    assert core.state is leads_to
    if leads_to is State.STOPPED and state is not State.STOPPED:
        assert (core.cause, core.words) == (event, "why")
        assert core.set_point.speed_mps == 0
        assert core._wish is None
    elif leads_to is state:
        assert core._wish is core_wish


def test_a_hundred_thousand_random_frames_never_move_the_vehicle():
    source = random.Random(7)
    bench = Bench()
    core = bench.core
    known = list(protocol.FRAMES)
    for number in range(100_000):
        if number % 10_000 == 1_000:
            core.enable(bench.now_s)
        can_id = source.choice(known) if source.random() < 0.8 else source.randrange(0x800)
        data = source.getrandbits(64).to_bytes(8, "big")
        if source.random() < 0.1:
            data = data[: source.randrange(9)]
        core.hear(can_id, data, bench.now_s)
        if number % 10 == 0:
            bench.now_s += STREAM_S
            for frame, sent in core.tick(bench.now_s):
                assert frame in protocol.COMMANDS
                if frame is protocol.MOTION_COMMAND:
                    assert sent == bytes(8)
            core.report(bench.now_s)


_HAPPENS = st.sampled_from(
    ["tick", "tick", "tick", "command", "enable", "brake", "hold", "status", "remote", "silent"]
)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(_HAPPENS, st.floats(-1, 1)), max_size=120))
def test_it_only_moves_enabled_on_a_fresh_command(happenings):
    bench = Bench()
    core, commanded_s, allowed = bench.core, -1e9, False
    for what, number in happenings:
        if what == "tick":
            before = len(bench.sent)
            bench.step()
            for motion in bench.motions(before):
                if motion.speed_mps != 0:
                    assert allowed
                    assert core.state is State.ENABLED
                    assert bench.now_s - commanded_s <= 0.25 + STREAM_S
        elif what == "command":
            core.command({"pedal": abs(number)}, bench.now_s)
            commanded_s = bench.now_s
        elif what == "enable":
            core.enable(bench.now_s)
            allowed = True
        elif what in ("brake", "hold"):
            core.brake(bench.now_s, latch=what == "brake")
            if what == "brake":
                allowed = False
        elif what == "silent":
            bench.hears = number > 0
        else:
            mode = protocol.REMOTE_CONTROL if what == "remote" else protocol.CAN_CONTROL
            bench.status = OK._replace(mode=mode)
