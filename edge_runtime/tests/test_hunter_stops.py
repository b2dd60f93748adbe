"""The Hunter's driver in made-up time: what of chassis and bus stops it."""

from __future__ import annotations

import pytest

from edge_runtime.tests.hunter_bench import (
    OK,
    STREAM_S,
    Bench,
    sent_ids,
)
from edge_runtime.vehicles.core import Event, State
from edge_runtime.vehicles.hunter import protocol


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
def test_what_the_chassis_says_stops_it_until_it_is_enabled_again(change, words, stands):
    bench = Bench().driving()
    bench.status = OK._replace(**change)
    bench.step(6, {"pedal": 1.0})
    assert bench.core.state is State.STOPPED
    assert bench.words == [words]
    assert (bench.core.standing(bench.now_s) == [words]) == stands
    bench.status = OK  # the chassis gives control back by itself
    count = len(bench.sent)
    bench.step(100, {"pedal": 1.0})
    assert set(bench.motions(count)) == {(0.0, 0.0)}
    assert bench.words == [words]
    assert bench.core.standing(bench.now_s) == []
    bench.enabled().step(20, {"pedal": 1.0})
    assert bench.words == []
    assert bench.speed_mps > 0


def test_a_motors_fault_stops_it():
    bench = Bench().driving()
    hot = protocol.MotorSlow(24.0, 30, 90, 0b10)
    bench.tell(protocol.REAR_LEFT_SLOW, hot)
    assert bench.words == ["rear left motor: motor overtemperature"]
    assert bench.core.cause is Event.FAULT
    bench.core.enable(bench.now_s)
    assert (bench.core.cause, bench.core.words) == (None, "")


def test_feedback_that_falls_silent_stops_it_and_the_brake_is_locked():
    bench = Bench().driving()
    bench.hears = False
    bench.step(12, {"pedal": 1.0})
    assert bench.words == ["the chassis sends no 0x221"]
    assert bench.core.standing(bench.now_s)
    assert 0x131 not in sent_ids(bench)[-10:]
    bench.step(60, {"pedal": 1.0})
    assert (0x131, b"\x01") in [(part.frame.can_id, part.data) for _, part in bench.sent[-10:]]


def test_a_status_that_falls_silent_alone():
    bench = Bench().driving()
    original, bench.tell = bench.tell, lambda frame, message: None
    for _ in range(20):
        bench.step(1, {"pedal": 1.0})
        original(protocol.MOTION_STATUS, protocol.MotionStatus(bench.speed_mps, 0.0))
    assert bench.words == ["the chassis sends no 0x211"]


FROZEN = "the chassis repeats itself: the counter of 0x211 stands still"


def test_frames_that_repeat_themselves_are_silence_after_three_of_them():
    bench = Bench().driving()
    bench.obeys, bench.counter = False, None
    bench.status = OK._replace(counter=bench.core.reports.status.counter)
    bench.step(10, {"pedal": 1.0})
    assert bench.core.state is State.ENABLED
    bench.step(7, {"pedal": 1.0})
    assert (bench.core.state, bench.core.cause) == (State.STOPPED, Event.SILENT)
    assert bench.words == [FROZEN]
    assert bench.core.standing(bench.now_s) == [FROZEN]  # it is not re-armed
    bench.core.enable(bench.now_s)
    bench.step(60, {"pedal": 1.0})
    assert bench.core.state is State.STOPPED
    assert bench.words[0] == f"not enabled within 1 s: {FROZEN}"
    bench.obeys, bench.counter = True, bench.status.counter
    bench.step(6)
    assert bench.core.standing(bench.now_s) == []
    bench.enabled()


@pytest.mark.parametrize("count", [2, 7, 50])
def test_frames_that_go_round_and_round_are_silence(count):
    bench = Bench().driving(8.0)
    newest = bench.core.reports.status.counter
    bench.counter = None
    for turn in range(20):
        bench.status = OK._replace(counter=(newest - count + 1 + turn % count) % 256)
        bench.step(5, {"pedal": 1.0})
    assert bench.words == [FROZEN]


def test_a_counter_that_runs_over_or_loses_two_frames_goes_on():
    bench = Bench().driving(1.0)
    for turn in range(600):
        bench.counter += (turn % 5) // 4 * 2
        bench.step(5, {"pedal": 1.0})
        assert bench.core.state is State.ENABLED, bench.words


def test_a_chassis_that_was_switched_off_may_count_from_0_again():
    bench = Bench().driving(20.0)
    bench.hears = False
    bench.step(30)
    bench.hears, bench.counter = True, 0
    bench.step(12).enabled()


@pytest.mark.parametrize(
    ("motion", "words"),
    [((3.0, 0.0), "the chassis reports 3.0 m/s"), ((0.0, 1.0), "a steering angle of 1.00 rad")],
)
def test_feedback_that_cannot_be_stops_it_before_the_next_tick(motion, words):
    bench = Bench().driving()
    bench.tell(protocol.MOTION_STATUS, protocol.MotionStatus(*motion))
    assert bench.core.state is State.STOPPED
    assert words in bench.words[0]


def test_feedback_that_could_not_be_while_it_is_enabled_stops_it_then():
    bench = Bench()
    bench.core.enable(bench.now_s)
    bench.step(1)
    bench.tell(protocol.MOTION_STATUS, protocol.MotionStatus(3.0, 0.0))
    assert bench.core.state is State.ENABLING
    bench.tell(protocol.SYSTEM_STATUS, OK)
    bench.step(1)
    assert bench.core.state is State.STOPPED


@pytest.mark.parametrize("speed_mps", [0.0, 0.7])
def test_a_drive_that_does_not_follow_is_stuck_and_its_brake_is_locked_at_once(speed_mps):
    bench = Bench().driving(1.0)
    bench.obeys, bench.speed_mps = False, speed_mps
    pedal = {"pedal": -1.0 if speed_mps else 1.0}
    while bench.core.state is State.ENABLED:
        assert bench.ticks < 200
        bench.step(1, pedal)
    bench.step(1, pedal)
    assert "the speed stays at" in bench.words[0]
    locks = (0x131, b"\x01") in [(part.frame.can_id, part.data) for _, part in bench.sent]
    assert locks == (speed_mps > 0)


def test_a_drive_with_a_lag_is_not_stuck():
    bench = Bench().enabled()
    bench.obeys = False
    for tick in range(1000):
        pedal = 1.0 if (tick // 150) % 2 == 0 else -1.0
        bench.step(1, {"pedal": pedal})
        bench.speed_mps += (bench.core.set_point.speed_mps - bench.speed_mps) * STREAM_S / 0.3
        assert bench.core.state is State.ENABLED, bench.words


def test_a_bus_that_takes_nothing_for_five_frames_stops_it():
    bench = Bench().driving()
    bench.core.bus_failed("Transmit buffer full", bench.now_s)
    bench.step(4, {"pedal": 1.0})
    bench.core.bus_failed("Transmit buffer full", bench.now_s)
    assert bench.core.state is State.ENABLED
    bench.step(2, {"pedal": 1.0})
    bench.core.bus_failed("Transmit buffer full", bench.now_s)
    assert bench.words == ["the CAN bus fails: Transmit buffer full"]
    bench.core.bus_works()
    assert bench.core.standing(bench.now_s) == []


def test_a_bus_that_failed_before_it_was_enabled_works_once_it_is_heard_again():
    bench = Bench()
    for now_s in (bench.now_s, bench.now_s + 1.0):
        bench.core.bus_failed("Network is down", now_s)
    assert bench.core.standing(bench.now_s)[-1] == "the CAN bus fails: Network is down"
    bench.step(5)  # nothing is sent that the bus could take
    assert bench.sent == []
    assert bench.core.standing(bench.now_s) == []
    bench.core.bus_failed("a frame lost, an hour later", bench.now_s + 3600.0)
    assert bench.core.report(bench.now_s).standing == []


def test_hearing_does_not_hide_that_the_bus_takes_nothing():
    bench = Bench().driving()
    for _ in range(8):
        bench.core.bus_failed("Transmit buffer full", bench.now_s)
        bench.step(1, {"pedal": 1.0})
    assert bench.words == ["the CAN bus fails: Transmit buffer full"]


def test_a_frame_that_was_not_taken_now_and_then_is_no_fault():
    bench = Bench().driving()
    for _ in range(50):
        bench.core.bus_failed("busy", bench.now_s)
        bench.core.bus_works()
        bench.step(1, {"pedal": 1.0})
    assert bench.core.state is State.ENABLED


def test_bus_off_stops_it_at_once():
    bench = Bench().driving()
    bench.core.bus_failed("bus-off", bench.now_s, fatal=True)
    assert bench.words == ["the CAN bus fails: bus-off"]


def test_somebody_else_who_commands_the_chassis_stops_it():
    bench = Bench().driving()
    bench.core.hear(0x111, bytes(8), bench.now_s)
    assert bench.words == ["somebody else sends 0x111"]
