"""The Hunter's driver in made-up time: how it is enabled, what stops it, and how it ends."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.tests.rigs import OK, PEDAL, STREAM_S, HunterRig
from edge_runtime.vehicles import core as rules
from edge_runtime.vehicles.core import Event, State
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.core import BUS_PATIENCE_S

TAKE, RELEASE, STAND = (0x421, b"\x01"), (0x131, b"\x00"), (0x111, bytes(8))
CLEAR, LOCK, GIVE_BACK = (0x441, b"\x00"), (0x131, b"\x01"), (0x421, b"\x00")
REMOTE = OK._replace(mode=protocol.REMOTE_CONTROL)


@pytest.fixture
def rig():
    return HunterRig()


@pytest.fixture
def driving(rig):
    return rig.driving()


def test_the_enable_sequence_and_its_confirmation(rig):
    rig.status = OK._replace(mode=protocol.STANDBY, brake=1)
    rig.core.enable(rig.now_s)
    rig.step()
    assert rig.frames() == [TAKE, RELEASE, STAND]
    rig.step(20, PEDAL)
    assert rig.core.state is State.ENABLING
    assert rig.ids().count(0x421) == 5  # each 0.1 s until it is confirmed
    rig.status = OK
    rig.step(6, PEDAL)
    assert rig.core.state is State.ENABLED
    count = rig.ids().count(0x421)
    rig.step(50, PEDAL)
    assert rig.ids().count(0x421) == count
    assert rig.speed_mps == pytest.approx(0.75, abs=0.1)


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
def test_a_chassis_that_does_not_confirm(rig, status, words):
    rig.status, rig.talks = status, status is not None
    rig.core.enable(rig.now_s)
    rig.step(48, PEDAL)
    assert rig.core.state is State.ENABLING
    rig.step(5, PEDAL)
    assert rig.core.state is State.STOPPED
    assert rig.words[0] == f"not enabled within 1 s: {words}"
    assert {data for can_id, data in rig.frames() if can_id == 0x111} == {bytes(8)}


@pytest.mark.parametrize(("faults", "clears"), [(0x0001, True), (0x1000, False), (0, False)])
def test_errors_are_cleared_before_control_is_asked_for_but_a_lost_link_is_not(rig, faults, clears):
    rig.status = OK._replace(faults=faults)
    rig.tell(protocol.SYSTEM_STATUS, rig.status)
    rig.core.enable(rig.now_s)
    rig.step()
    assert rig.frames() == [*([CLEAR] if clears else []), TAKE, RELEASE, STAND]
    rig.step(11)
    assert (0x441 in rig.ids()) == clears


def test_time_limits_to_the_instant(driving):
    core = driving.core
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


def test_what_is_at_rest(rig):
    def is_at_rest(later_s=0.0):
        return rig.core.is_at_rest(rig.now_s + later_s)

    assert is_at_rest()  # never enabled
    rig.driving()
    assert not is_at_rest()
    rig.status = REMOTE
    rig.step(6)
    rig.speed_mps, rig.obeys = 1.0, False
    rig.step(6)
    assert is_at_rest()  # a person has it
    rig.status = OK
    rig.step(6)
    assert not is_at_rest()
    rig.core.bus_failed("bus-off", rig.now_s, fatal=True)
    assert is_at_rest()  # nothing reaches it
    rig.core.bus_works()
    rig.speed_mps = 0.0
    rig.step(1)
    assert is_at_rest()
    assert not is_at_rest(later_s=1.0)  # that was then


@pytest.mark.parametrize("age_s", [0.0, 0.3])
def test_a_status_from_before_confirms_nothing(rig, age_s):
    rig.tell(protocol.SYSTEM_STATUS, OK)
    rig.now_s += age_s
    rig.core.enable(rig.now_s)
    for wait_s in (0.0, 0.05):
        rig.now_s += wait_s
        rig.tell(protocol.REAR_LEFT_SLOW, protocol.MotorSlow(24.0, 30, 30, 0))
        assert rig.core.state is State.ENABLING
    rig.tell(protocol.SYSTEM_STATUS, OK)
    assert rig.core.state is State.ENABLED


def test_the_remote_control_keeps_its_brake_and_its_control_at_the_end(driving):
    driving.status = REMOTE
    driving.obeys, driving.speed_mps = False, 1.0  # a person drives
    count = len(driving.sent)
    driving.step(200, PEDAL)
    assert set(driving.ids(count + 6)) == {0x111}
    assert [part.frame.can_id for part in driving.core.close(driving.now_s)] == [0x111, 0x421]


@pytest.mark.parametrize("brakes", [True, False])
def test_the_end_stands_parks_and_gives_control_back(driving, brakes):
    if brakes:
        driving.core.brake(driving.now_s)
    ends = driving.core.close(driving.now_s)
    assert [(part.frame.can_id, part.data) for part in ends] == [STAND, LOCK, GIVE_BACK]
    assert driving.core.tick(driving.now_s) == []


def test_a_hundred_thousand_random_frames_never_move_the_vehicle(rig):
    source, core, known = random.Random(7), rig.core, list(protocol.FRAMES)
    for number in range(100_000):
        if number % 10_000 == 1_000:
            core.enable(rig.now_s)
        can_id = source.choice(known) if source.random() < 0.8 else source.randrange(0x800)
        data = source.getrandbits(64).to_bytes(8, "big")
        if source.random() < 0.1:
            data = data[: source.randrange(9)]
        core.hear(can_id, data, rig.now_s)
        if number % 10 == 0:
            rig.now_s += STREAM_S
            for frame, sent in core.tick(rig.now_s):
                assert frame in protocol.COMMANDS
                if frame is protocol.MOTION_COMMAND:
                    assert sent == bytes(8)
            core.report(rig.now_s)


_HAPPENS = st.sampled_from(
    ["tick", "tick", "tick", "command", "enable", "brake", "hold", "status", "remote", "silent"]
)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(_HAPPENS, st.floats(-1, 1)), max_size=120))
def test_it_only_moves_enabled_on_a_fresh_command(happenings):
    rig = HunterRig()
    core, commanded_s, allowed = rig.core, -1e9, False
    for what, number in happenings:
        if what == "tick":
            before = len(rig.asked)
            rig.step()
            if any(rig.speeds(before)):
                assert allowed
                assert core.state is State.ENABLED
                assert rig.now_s - commanded_s <= 0.25 + STREAM_S
        elif what == "command":
            core.command({"pedal": abs(number)}, rig.now_s)
            commanded_s = rig.now_s
        elif what == "enable":
            core.enable(rig.now_s)
            allowed = True
        elif what in ("brake", "hold"):
            core.brake(rig.now_s, latch=what == "brake")
            allowed = allowed and what == "hold"
        elif what == "silent":
            rig.talks = number > 0
        else:
            rig.status = REMOTE if what == "remote" else OK


# What of chassis and bus stops it.


@pytest.mark.parametrize(
    ("change", "words", "stands"),
    [
        ({"mode": protocol.REMOTE_CONTROL}, "the remote control drives", True),
        ({"state": protocol.STATE_ESTOP}, "the emergency stop is pressed", True),
        ({"mode": protocol.STANDBY}, "the chassis is in standby, not under CAN control", False),
        ({"brake": 1}, "the chassis has locked its brake", False),
        ({"faults": 0x1000}, "link to the upper computer lost", False),
        ({"faults": 0x0241}, "steering encoder, battery undervoltage, overtemperature", False),
        ({"state": protocol.STATE_EXCEPTION}, "the chassis is in state 2 (exception)", False),
    ],
)
def test_what_the_chassis_says_stops_it_until_it_is_enabled_again(driving, change, words, stands):
    driving.status = OK._replace(**change)
    driving.step(6, PEDAL)
    assert driving.core.state is State.STOPPED
    assert driving.words == [words]
    assert (driving.report.standing == [words]) == stands
    driving.status = OK  # the chassis gives control back by itself
    count = len(driving.asked)
    driving.step(100, PEDAL)
    assert set(driving.speeds(count)) == {0.0}
    assert driving.words == [words]
    assert driving.report.standing == []
    driving.enabled().step(20, PEDAL)
    assert driving.words == []
    assert driving.speed_mps > 0


def test_a_motors_fault_stops_it(driving):
    driving.tell(protocol.REAR_LEFT_SLOW, protocol.MotorSlow(24.0, 30, 90, 0b10))
    assert driving.words == ["rear left motor: motor overtemperature"]
    assert driving.core.cause is Event.FAULT
    driving.core.enable(driving.now_s)
    assert (driving.core.cause, driving.core.words) == (None, "")


def test_feedback_that_falls_silent_stops_it_and_the_brake_is_locked(driving):
    driving.talks = False
    driving.step(12, PEDAL)
    assert driving.words == driving.report.standing == ["the chassis sends no 0x221"]
    assert 0x131 not in driving.ids(-10)
    driving.step(60, PEDAL)
    assert LOCK in driving.frames(-10)


def test_a_status_that_falls_silent_alone(driving):
    driving.talks = False
    for _ in range(20):
        driving.step(1, PEDAL)
        driving.tell(protocol.MOTION_STATUS, protocol.MotionStatus(driving.speed_mps, 0.0))
    assert driving.words == ["the chassis sends no 0x211"]


FROZEN = "the chassis repeats itself: the counter of 0x211 stands still"


def test_frames_that_repeat_themselves_are_silence_after_three_of_them(driving):
    driving.obeys, driving.counter = False, None
    driving.status = OK._replace(counter=driving.core.reports.status.counter)
    driving.step(10, PEDAL)
    assert driving.core.state is State.ENABLED
    driving.step(7, PEDAL)
    assert (driving.core.state, driving.core.cause) == (State.STOPPED, Event.SILENT)
    assert driving.words == [FROZEN]
    assert driving.report.standing == [FROZEN]  # it is not re-armed
    driving.core.enable(driving.now_s)
    driving.step(60, PEDAL)
    assert driving.core.state is State.STOPPED
    assert driving.words[0] == f"not enabled within 1 s: {FROZEN}"
    driving.obeys, driving.counter = True, driving.status.counter
    driving.step(6)
    assert driving.report.standing == []
    driving.enabled()


@pytest.mark.parametrize("count", [2, 7, 50])
def test_frames_that_go_round_and_round_are_silence(rig, count):
    newest = rig.driving(8.0).core.reports.status.counter
    rig.counter = None
    for turn in range(20):
        rig.status = OK._replace(counter=(newest - count + 1 + turn % count) % 256)
        rig.step(5, PEDAL)
    assert rig.words == [FROZEN]


def test_a_counter_that_runs_over_or_loses_two_frames_goes_on(driving):
    for turn in range(600):
        driving.counter += (turn % 5) // 4 * 2
        driving.step(5, PEDAL)
        assert driving.core.state is State.ENABLED, driving.words


def test_a_chassis_that_was_switched_off_may_count_from_0_again(rig):
    rig.driving(20.0).talks = False
    rig.step(30)
    rig.talks, rig.counter = True, 0
    rig.step(12).enabled()


@pytest.mark.parametrize(
    ("motion", "words"),
    [((3.0, 0.0), "the chassis reports 3.0 m/s"), ((0.0, 1.0), "a steering angle of 1.00 rad")],
)
def test_feedback_that_cannot_be_stops_it_before_the_next_tick(driving, motion, words):
    driving.tell(protocol.MOTION_STATUS, protocol.MotionStatus(*motion))
    assert driving.core.state is State.STOPPED
    assert words in driving.words[0]


def test_feedback_that_could_not_be_while_it_is_enabled_stops_it_then(rig):
    rig.core.enable(rig.now_s)
    rig.step(1)
    rig.tell(protocol.MOTION_STATUS, protocol.MotionStatus(3.0, 0.0))
    assert rig.core.state is State.ENABLING
    rig.tell(protocol.SYSTEM_STATUS, OK)
    rig.step(1)
    assert rig.core.state is State.STOPPED


@pytest.mark.parametrize("speed_mps", [0.0, 0.7])
def test_a_drive_that_does_not_follow_is_stuck_and_its_brake_is_locked_at_once(driving, speed_mps):
    driving.obeys, driving.speed_mps = False, speed_mps
    pedal = {"pedal": -1.0 if speed_mps else 1.0}
    while driving.core.state is State.ENABLED:
        assert driving.ticks < 200
        driving.step(1, pedal)
    driving.step(1, pedal)
    assert "the speed stays at" in driving.words[0]
    assert (LOCK in driving.frames()) == (speed_mps > 0)


FULL = "Transmit buffer full"


@pytest.mark.parametrize(
    ("failures", "works_between", "words"),
    [
        ([0, 4], False, []),  # by the tick: for less than five frames
        ([0, 4, 6], False, [f"the CAN bus fails: {FULL}"]),
        (range(8), False, [f"the CAN bus fails: {FULL}"]),  # though it hears all the time
        (range(50), True, []),  # a frame that was not taken now and then
    ],
)
def test_a_bus_that_takes_nothing_for_five_frames_stops_it(driving, failures, works_between, words):
    for tick in range(max(failures) + 1):
        if tick in failures:
            driving.core.bus_failed(FULL, driving.now_s)
        if works_between:
            driving.core.bus_works()
        driving.step(1, PEDAL)
    assert driving.words == words
    assert driving.core.state is (State.STOPPED if words else State.ENABLED)
    driving.core.bus_works()
    assert driving.report.standing == []


def test_a_bus_that_failed_before_it_was_enabled_works_once_it_is_heard_again(rig):
    for now_s in (rig.now_s, rig.now_s + 1.0):
        rig.core.bus_failed("Network is down", now_s)
    assert rig.report.standing[-1] == "the CAN bus fails: Network is down"
    rig.step(5)  # nothing is sent that the bus could take
    assert rig.sent == []
    assert rig.report.standing == []
    rig.core.bus_failed("a frame lost, an hour later", rig.now_s + 3600.0)
    assert rig.report.standing == []


def test_bus_off_and_another_sender_stop_it_at_once():
    off, other = HunterRig().driving(), HunterRig().driving()
    off.core.bus_failed("bus-off", off.now_s, fatal=True)
    assert off.words == ["the CAN bus fails: bus-off"]
    other.core.hear(0x111, bytes(8), other.now_s)
    assert other.words == ["somebody else sends 0x111"]
