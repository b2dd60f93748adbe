"""The Hunter's driver in made-up time: how it is enabled, what stops it, and how it ends."""

import pytest

from edge_runtime.tests.rigs import OK, PEDAL, SPEC, HunterRig
from edge_runtime.vehicles.hunter import STATUS_SILENCE_S, Reports, protocol
from edge_runtime.vehicles.plausibility import Fault
from edge_runtime.vehicles.streamed import VehicleEvent, VehicleState

TAKE, RELEASE, STAND = (0x421, b"\x01"), (0x131, b"\x00"), (0x111, bytes(8))
CLEAR, LOCK, GIVE_BACK = (0x441, b"\x00"), (0x131, b"\x01"), (0x421, b"\x00")
REMOTE = OK._replace(mode=protocol.REMOTE_CONTROL)
SILENT_S = STATUS_SILENCE_S + 1e-9


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
    assert rig.core.state is VehicleState.ENABLING
    assert rig.ids().count(0x421) == 5  # each 0.1 s until it is confirmed
    rig.status = OK
    rig.step(6, PEDAL)
    assert rig.core.state is VehicleState.ENABLED
    rig.step(50, PEDAL)
    assert rig.ids().count(0x421) <= 6


# What it says, in words, and whether it outranks us: then an `enable` would be in vain.
CHASSIS_SAYS = [
    ({"mode": protocol.REMOTE_CONTROL}, "the remote control drives", True),
    ({"state": protocol.STATE_ESTOP}, "the emergency stop is pressed", True),
    ({"mode": protocol.STANDBY}, "the chassis is in mode 0, not under CAN control", False),
    ({"mode": 7}, "the chassis is in mode 7, not under CAN control", False),
    ({"brake": 1}, "the chassis has locked its brake", False),
    ({"faults": 0x1000}, "link to the upper computer lost", False),
    ({"faults": 0x0241}, "battery undervoltage, overtemperature, steering encoder", False),
    ({"state": protocol.STATE_EXCEPTION}, "the chassis is in state 2", False),
]


@pytest.mark.parametrize(
    ("change", "words", "outranks"), [*CHASSIS_SAYS, (None, "the chassis sends no 0x221", False)]
)
def test_a_chassis_that_does_not_confirm(rig, change, words, outranks):
    rig.status, rig.talks = OK._replace(**change or {}), change is not None
    rig.core.enable(rig.now_s)
    rig.step(48, PEDAL)
    assert rig.core.state is (VehicleState.STOPPED if outranks else VehicleState.ENABLING)
    rig.step(5, PEDAL)
    assert rig.core.state is VehicleState.STOPPED
    assert rig.words[0] == (words if outranks else f"not enabled within 1 s: {words}")
    assert set(rig.speeds()) == {0.0}


@pytest.mark.parametrize(
    ("change", "clears"),
    [
        ({"faults": 0x0001}, True), ({"state": 2}, True), ({"state": 3}, False),
        ({"faults": 0x1000}, False), ({}, False),
    ],
)  # fmt: skip
def test_errors_are_cleared_before_control_is_asked_for_but_a_lost_link_is_not(rig, change, clears):
    rig.status = OK._replace(**change)
    rig.tell(protocol.SYSTEM_STATUS, rig.status)
    rig.core.enable(rig.now_s)
    rig.step()
    assert rig.frames() == [*([CLEAR] if clears else []), TAKE, RELEASE, STAND]
    rig.step(11)
    assert (0x441 in rig.ids()) == clears


def test_what_is_at_rest(rig):
    def is_at_rest(later_s=0.0):
        return rig.core.is_at_rest(rig.now_s + later_s)

    assert is_at_rest()  # never enabled
    rig.driving()
    assert not is_at_rest()
    rig.status, rig.obeys = REMOTE, False
    rig.step(6)
    assert is_at_rest()  # a person has it
    rig.status = OK._replace(mode=7)
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
        rig.tell(protocol.MOTORS_SLOW[2], protocol.MotorSlow(24.0, 30, 30, 0))
        assert rig.core.state is VehicleState.ENABLING
    rig.tell(protocol.SYSTEM_STATUS, OK)
    assert rig.core.state is VehicleState.ENABLED
    rig.core.enable(rig.now_s)
    rig.tell(protocol.MOTION_STATUS, protocol.WheelMotion(2.0, 0.0))
    assert rig.core.cause is Fault.LYING  # that waits for no status


@pytest.mark.parametrize("ends", ["driving", "by the remote control"])
def test_the_end_stands_and_parks_unless_a_person_drives(driving, ends):
    parks = [LOCK]
    if ends == "by the remote control":
        driving.status, driving.obeys, driving.speed_mps = REMOTE, False, 1.0
        count, parks = len(driving.sent), []
        driving.step(200, PEDAL)
        assert set(driving.ids(count + 6)) == {0x111}
    sent = [(part.frame.can_id, part.data) for part in driving.core.close(driving.now_s)]
    assert sent == [STAND, *parks, GIVE_BACK]
    assert driving.core.tick(driving.now_s) == []


@pytest.mark.parametrize(("change", "words", "outranks"), CHASSIS_SAYS)
def test_what_the_chassis_says_stops_it_until_it_is_enabled_again(driving, change, words, outranks):
    driving.status = OK._replace(**change)
    driving.step(6, PEDAL)
    assert driving.core.state is VehicleState.STOPPED
    assert driving.words == [words]
    assert (driving.report.standing == [words]) == outranks
    driving.status = OK  # the chassis gives control back by itself
    count = len(driving.asked)
    driving.step(20, PEDAL)
    assert set(driving.speeds(count)) == {0.0}
    assert (driving.words, driving.report.standing) == ([words], [])


@pytest.mark.parametrize(
    ("frame", "message", "cause", "words"),
    [
        (protocol.MOTORS_SLOW[2], protocol.MotorSlow(24.0, 30, 90, 0b10),
         VehicleEvent.FAULT, "rear left motor: motor overtemperature"),
        (protocol.MOTION_COMMAND, protocol.WheelMotion(0.0, 0.0),
         VehicleEvent.FOREIGN, "somebody else sends 0x111"),
        (protocol.MOTION_STATUS, protocol.WheelMotion(2.0, 0.0),
         Fault.LYING, "the chassis reports 2.0 m/s"),
        (protocol.MOTION_STATUS, protocol.WheelMotion(0.0, 0.8),
         Fault.LYING, "a steering angle of 0.80 rad"),
        (None, "bus-off", VehicleEvent.BUS, "the CAN bus fails: bus-off"),
    ],
)  # fmt: skip
def test_what_stops_it_before_the_next_tick(driving, frame, message, cause, words):
    if frame:
        driving.tell(frame, message)
    else:
        driving.core.bus_failed(message, driving.now_s, fatal=True)
    assert (driving.core.state, driving.core.cause) == (VehicleState.STOPPED, cause)
    assert words in driving.words[0]


def test_no_more_steering_is_reported_than_the_wheels_reach():
    rig = HunterRig("congestion", scale=0.02)
    rig.tell(protocol.MOTION_STATUS, protocol.WheelMotion(0.1, -0.74))
    assert rig.core.reports.lie() is None  # below 1.3 times the limit
    assert rig.report.action["steering"] == rig.core.similarity.limits()["steering"].high < 0.6


@pytest.mark.parametrize(
    ("counters", "alive"),
    [
        ([(0.0, 200)], 0.0),  # the first one
        ([(0.0, 200), (0.1, 200 + 127 - 256)], 0.1),  # ahead by less than half of the circle
        ([(0.0, 200), (0.1, 200 + 128 - 256)], 0.0),
        ([(0.0, 255), (0.1, 0)], 0.1),  # the next one
        ([(0.0, 200), (0.1, 199), (0.2, 200)], 0.0),  # round and round
        ([(0.0, 200), (STATUS_SILENCE_S, 200)], 0.0),  # begun anew, but not after a silence
        ([(0.0, 200), (SILENT_S, 200)], SILENT_S),
    ],
)
def test_which_counter_is_a_sign_of_life(counters, alive):
    reports = Reports(SPEC, "v2")
    for now_s, counter in counters:
        status = protocol.encode(protocol.SYSTEM_STATUS, OK._replace(counter=counter))
        reports.hear(0x211, status, now_s)
    assert reports.status_s == alive


@pytest.mark.parametrize(("missing", "after_ticks"), [("0x221", 12), ("0x211", 20)])
def test_feedback_that_falls_silent_stops_it_and_the_brake_is_locked(driving, missing, after_ticks):
    driving.talks = False
    for tick in range(after_ticks + 60):
        if tick == after_ticks:
            assert driving.words == driving.report.standing == [f"the chassis sends no {missing}"]
            assert LOCK not in driving.frames(-10)
        driving.step(1, PEDAL)
        if missing == "0x211":  # the status; not the motion
            motion = protocol.WheelMotion(driving.speed_mps or 0.1, 0.0)
            driving.tell(protocol.MOTION_STATUS, motion)
    assert LOCK in driving.frames(-10)


def test_the_brake_is_locked_where_it_rolls_on_and_complains_again_and_again(driving):
    driving.status, driving.obeys = OK._replace(faults=0x0001), False
    driving.step(70, PEDAL)
    assert LOCK in driving.frames(-10)


FROZEN = "the chassis repeats itself: the counter of 0x211 stands still"


def test_frames_that_repeat_themselves_are_silence_after_three_of_them(driving):
    driving.obeys, driving.counter = False, None
    driving.status = OK._replace(counter=driving.core.reports.status.counter)
    driving.step(10, PEDAL)
    assert driving.core.state is VehicleState.ENABLED
    driving.step(7, PEDAL)
    assert (driving.core.state, driving.core.cause) == (VehicleState.STOPPED, Fault.SILENT)
    assert driving.words == driving.report.standing == [FROZEN]  # it is not re-armed
    driving.core.enable(driving.now_s)
    driving.step(60, PEDAL)
    assert driving.words[0] == f"not enabled within 1 s: {FROZEN}"


@pytest.mark.parametrize("speed_mps", [0.0, 0.7, -0.7])
def test_a_drive_that_does_not_follow_is_stuck_and_its_brake_is_locked_at_once(driving, speed_mps):
    driving.obeys, driving.speed_mps = False, speed_mps
    pedal = {"pedal": -1.0 if speed_mps else 1.0}
    while driving.core.state is VehicleState.ENABLED:
        assert driving.ticks < 200
        driving.step(1, pedal)
    driving.step(1, pedal)
    assert "the speed stays at" in driving.words[0]
    assert (LOCK in driving.frames()) == (speed_mps != 0)


@pytest.mark.parametrize(
    ("ticks", "works_between", "words"),
    [
        (5, False, []),
        (8, False, ["the CAN bus fails: full"]),  # though it hears all the time
        (50, True, []),  # a frame that was not taken now and then
    ],
)
def test_a_bus_that_takes_nothing_for_five_frames_stops_it(driving, ticks, works_between, words):
    for _ in range(ticks):
        driving.core.bus_failed("full", driving.now_s)
        if works_between:
            driving.core.bus_works()
        driving.step(1, PEDAL)
    assert driving.words == words
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
