"""What holds for every streamed vehicle, in made-up time; and the thread that sends, in real."""

import contextlib
import math
import time
from unittest.mock import Mock, call

import pytest
from hil_tests.processes import wait_until
from hypothesis import example, given
from hypothesis import strategies as st

from edge_runtime import log
from edge_runtime.tests.rigs import PEDAL, SPEC, STREAM_S, HunterRig, Ros2Rig
from edge_runtime.vehicles import streamed
from edge_runtime.vehicles.mapping import wish_of
from edge_runtime.vehicles.plausibility import Fault, Finding
from edge_runtime.vehicles.streamed import LEADS_TO, Speeds, VehicleEvent, VehicleState


@pytest.fixture(params=[HunterRig, Ros2Rig])
def make(request):
    return request.param


@pytest.fixture
def rig(make):
    return make()


def test_a_new_core_knows_and_sends_nothing(rig):
    core, report = rig.core, rig.core.report(0.0)
    assert (core.state, core.cause, core.words) == (VehicleState.DISABLED, None, "")
    assert (report.faults, report.speed_mps, report.battery_v) == ([], 0.0, None)
    assert report.action == {"pedal": -1.0, "steering": 0.0}
    assert report.self_braking
    assert (core.standing(0.0), core.late_at_s) == ([rig.silence], math.inf)
    core.brake(rig.now_s)
    rig.step(100, PEDAL)
    assert not core.close(rig.now_s)
    assert (rig.sent, core.state) == ([], VehicleState.DISABLED)


@pytest.mark.parametrize(
    ("period_s", "holds_s", "silence_s"),
    [(0.1, 0.24, 0.2), (0.05, 0.13, 0.1), (0.5, 1.12, 1.0), (0.01, 0.042, 0.06)],
)
def test_two_periods_of_the_policy_hold_a_command_and_miss_feedback(
    rig, period_s, holds_s, silence_s
):
    rig.core.follow_period(period_s)
    rig.enabled().core.command(PEDAL, rig.now_s)
    assert rig.core.late_at_s == pytest.approx(rig.now_s + holds_s)
    assert rig.core._heard.silence_s == pytest.approx(silence_s)
    while rig.now_s < (late_s := rig.core.late_at_s) - 1e-9:
        rig.step()
    for now_s, cause in ((late_s, None), (late_s + 0.001, VehicleEvent.COMMAND_LATE)):
        rig.core.tick(now_s)
        assert rig.core.cause is cause


def test_to_enable_it_again_makes_it_stand_and_gives_it_the_whole_time_again(rig):
    rig.driving().talks = False
    count = len(rig.asked)
    for _ in range(2):
        rig.core.enable(rig.now_s)
        rig.step(45)
    assert rig.core.state is VehicleState.ENABLING
    assert set(rig.speeds(count)) == {0.0}


def test_a_vehicle_that_confirms_nothing_is_stopped_after_a_second_whenever_it_is_looked_at(rig):
    rig.core.enable(rig.now_s)
    for late_s, state in ((0.99, VehicleState.ENABLING), (1.37, VehicleState.STOPPED)):
        rig.core.tick(rig.now_s + late_s)
        assert rig.core.state is state


TOLERANCE_RAD = 0.1 * SPEC.centre_rad(SPEC.max_inner_steering_rad)
FOUND_WITHIN_S = 0.7
"""0.4 s to follow, 0.1 s of deviation, and 46 mrad at 1 rad/s, as for one that came from there."""


@pytest.mark.parametrize("steering", [0.0, -0.79, 1.0])
@pytest.mark.parametrize("jammed", [-0.570, 0.570, 0.0, "asked"])
@pytest.mark.parametrize("excess", [0.95, 1.05])
def test_a_wheel_at_a_wrong_angle_is_found_for_small_actions_and_for_large(
    make, steering, jammed, excess
):
    """The wheel, not the action: 0.081 rad are full action, and all beyond is reported as that."""
    rig = make("congestion").enabled()
    rig.step(100, {"steering": steering}, scenario_speed_mps=4.0)
    asked_rad = rig.core.similarity.centre_rad(steering)
    wheel_rad = SPEC.centre_rad(0.0 if jammed == "asked" else jammed)
    if jammed == "asked":
        wheel_rad = asked_rad - excess * TOLERANCE_RAD
    rig.jammed_rad = math.copysign(SPEC.inner_rad(wheel_rad), wheel_rad)
    wrong = abs(wheel_rad - asked_rad) > TOLERANCE_RAD
    rig.step(round(FOUND_WITHIN_S / STREAM_S), {"steering": steering}, scenario_speed_mps=4.0)
    assert rig.core.cause is (Fault.STEERING_STUCK if wrong else None)
    assert rig.core.set_point.speed_mps == 0.0 if wrong else rig.speed_mps > 0.9


@pytest.mark.parametrize(("speed_mps", "pedal"), [(0.0, 1.0), (0.1, -1.0)])
def test_a_wheel_need_not_turn_where_it_stands_nor_where_it_is_to_stand(rig, speed_mps, pedal):
    rig.jammed_rad = 0.5
    rig.enabled().obeys, rig.speed_mps = False, speed_mps
    rig.step(10, {"pedal": pedal})
    assert rig.report.action["pedal"] == 0.0  # a throttle that does not bite yet is no brake
    rig.step(90, {"pedal": pedal})
    assert rig.core.cause is (Fault.STUCK if pedal > 0 else None)


@pytest.mark.parametrize("pedal", [0.05, 1.0])
@pytest.mark.parametrize("scale", [0.02, 0.05, 0.1, 0.25])
def test_a_runaway_is_found_at_any_scale_and_throttle(make, scale, pedal):
    """What is asked stays behind the measured speed: at small scales by more than a full lead."""
    rig = make(scale=scale).enabled()
    rig.step(55, {"pedal": pedal})
    rig.obeys = False
    for _ in range(60):
        rig.speed_mps = min(rig.speed_mps + 2.0 * STREAM_S, 1.6)
        rig.step(1, {"pedal": pedal})
    assert rig.core.cause is Fault.STUCK


def test_pedals_become_a_speed_and_the_speed_comes_back_as_the_scenarios(rig):
    """Full throttle: 3 m/s2 of the car, a quarter of it on the Hunter; its top speed in the end."""
    report = rig.driving(1.0).report
    assert report.speed_mps == pytest.approx(46 * 0.75 * STREAM_S)  # its first command came late
    assert report.scenario_speed_mps == pytest.approx(4 * report.speed_mps)
    assert report.commanded_speed_mps == pytest.approx(report.speed_mps, abs=0.002)
    assert report.action["pedal"] == pytest.approx(1.0, abs=0.05)
    assert report.battery_v == rig.battery_v
    rig.step(20, {"pedal": -0.5})
    assert rig.report.action["pedal"] == pytest.approx(-0.5, abs=0.05)
    rig.step(150, PEDAL)
    assert rig.core.set_point.speed_mps == SPEC.max_speed_mps
    assert rig.report.scenario_speed_mps == pytest.approx(6.0)
    assert rig.report.action["pedal"] == pytest.approx(0.0, abs=0.01)
    rig.core.brake(rig.now_s, latch=False)
    assert rig.report.commanded_speed_mps == 0.0  # before the next tick


def test_a_policy_without_a_pedal_has_the_scenarios_speed_and_its_own_steering(make):
    rig = make("congestion").enabled()
    rig.step(200, {"steering": -1.0}, scenario_speed_mps=4.0)
    assert rig.speed_mps == pytest.approx(1.0)
    similarity = rig.core.similarity
    assert similarity.centre_rad(-1.0) > 0  # -1 turns left
    assert rig.inner_rad == pytest.approx(SPEC.inner_rad(similarity.centre_rad(-1.0)), abs=1e-3)
    assert rig.report.action["steering"] == pytest.approx(-1.0, abs=0.02)


def lie(rig):
    rig.speed_mps, rig.obeys = 3.0, False
    rig.step(2, PEDAL)
    rig.speed_mps, rig.obeys = 0.0, True
    return rig.lie


def be_stuck(rig):
    rig.speed_mps, rig.obeys = 0.0, False
    rig.step(100, PEDAL)
    rig.obeys = True
    return "the speed stays at 0.00 m/s"


def be_astray(rig):
    rig.jammed_rad = -0.3
    rig.step(40, PEDAL)
    rig.jammed_rad = None
    return "the steering stays at -0.2"


@pytest.mark.parametrize(
    ("stop", "cause"),
    [
        (lie, Fault.LYING), (be_stuck, Fault.STUCK), (be_astray, Fault.STEERING_STUCK),
    ],
)  # fmt: skip
def test_every_fault_latches_until_it_is_enabled_again(rig, stop, cause):
    words = stop(rig.driving())
    assert rig.core.cause is cause
    assert rig.words[0].startswith(words)
    assert rig.report.self_braking
    count = len(rig.asked)  # all is well again, and commands come: it stands nevertheless
    rig.step(20, PEDAL)
    assert set(rig.speeds(count)) == {0.0}
    assert rig.report.standing == []
    assert rig.enabled().step(50, PEDAL).speed_mps > 0.5


@pytest.mark.parametrize("state", VehicleState)
@pytest.mark.parametrize("event", LEADS_TO)
def test_the_core_goes_where_the_table_says(rig, state, event):
    core = rig.core
    core.state, core.set_point.speed_mps = state, 1.0
    core._wish = wish = wish_of(PEDAL, None)
    core._apply(Finding(event, "why"), rig.now_s)
    assert core.state is LEADS_TO[event].get(state, state)
    assert core._wish is (wish if core.state is state else None)
    assert core.set_point.speed_mps == (1.0 if core.state is state else 0.0)
    if core.state is VehicleState.STOPPED and state is not VehicleState.STOPPED:
        assert (core.cause, core.words) == (event, "why")


DRIVES: list = [("enable",), ("tick", 6), ("command", 1.0, 0.0, None), ("tick", 1)]
"""Chance alone hardly ever moves it."""
WILD = st.floats(allow_nan=False, allow_infinity=False)
HAPPENINGS = st.one_of(
    st.tuples(st.just("tick"), st.integers(1, 20)),
    st.tuples(st.just("command"), WILD | st.floats(0, 1), WILD, st.none() | WILD),
    st.tuples(st.just("enable")),
    st.tuples(st.just("brake"), st.booleans()),
    st.tuples(st.just("talks"), st.booleans()),
    st.tuples(st.just("disturb"), st.integers(-(2**63), 2**63 - 1)),
)


@pytest.mark.parametrize("make_rig", [HunterRig, Ros2Rig])
@example(True, [("command", 6e307, 0.0, None), ("tick", 1)])  # inf * 0 s
@given(st.booleans(), st.lists(HAPPENINGS, max_size=60))
def test_it_only_moves_enabled_on_a_fresh_command_and_within_its_limits(
    make_rig, drives, happenings
):
    rig, commanded_s, may_move = make_rig("congestion"), -1e9, False
    for what, *values in [*(DRIVES if drives else ()), *happenings]:
        if what == "tick":
            for _ in range(*values):
                count = len(rig.asked)
                rig.step()
                for speed_mps in filter(None, rig.speeds(count)):
                    assert may_move
                    assert rig.sent_in is VehicleState.ENABLED
                    assert 0.0 < speed_mps <= SPEC.max_speed_mps
                    assert rig.now_s - commanded_s <= 0.25 + STREAM_S
        elif what == "command":
            pedal, steering, scenario_speed_mps = values
            rig.core.command({"pedal": pedal, "steering": steering}, rig.now_s, scenario_speed_mps)
            commanded_s = rig.now_s
        elif what == "enable":
            rig.core.enable(rig.now_s)
            may_move = True
        elif what == "brake":
            rig.core.brake(rig.now_s, *values)
            may_move = may_move and not values[0]
        elif what == "talks":
            (rig.talks,) = values
        else:
            rig.disturb(*values)
        assert abs(rig.inner_rad) <= SPEC.max_inner_steering_rad
        assert all(-1.0 <= value <= 1.0 for value in rig.report.action.values())


def test_speeds_by_hand():
    """Where it stands, and the acceleration of the last 0.1 s."""
    speeds = Speeds()
    assert (speeds.speed_mps, speeds.stands, speeds.acceleration_mps2()) == (0.0, True, 0.0)
    for now_s, speed_mps, stands, acceleration in (
        (5.0, 3.0, False, 0.0),
        (5.0, 0.02, False, 0.0),  # twice in one moment
        (5.2, 0.0199, True, 0.0),  # the earlier ones are too old
        (5.25, 5.0, False, 99.602),
        (5.3, -0.1801, False, -2.0),
    ):
        speeds.note(speed_mps, now_s)
        assert speeds.stands is stands
        assert speeds.acceleration_mps2() == pytest.approx(acceleration)


class Sender(streamed.StreamedVehicle):
    """Notes when it sends, and pauses at the first; `late_s`: a command becomes too old."""

    def __init__(self, pause_s=0.0, late_s=math.inf):
        super().__init__(HunterRig().core)
        self.sent: list = []
        self.pause_s, self.late_s = pause_s, late_s
        self._stream.start()

    def _send_due(self):
        self.sent.append(time.monotonic())
        time.sleep(0.0 if self.sent[1:] else self.pause_s)
        return True

    def _late_at_s(self):
        return self.late_s if time.monotonic() < self.late_s else math.inf

    def _leave(self):
        self.sent.append("too early" if self._stream.is_alive() else "left")


def test_it_sends_fifty_times_a_second_and_after_a_pause_once_for_all_missed_periods():
    with contextlib.closing(Sender(pause_s=0.3)) as vehicle:
        wait_until(lambda: len(vehicle.sent) > 21, "0.4 s of sending")
        # A machine that pauses loses periods; nothing may make it send more often than asked.
        assert vehicle.sent[21] - vehicle.sent[1] > 0.33
        assert vehicle._stream.daemon  # one that hangs in a bus must not keep the process
    assert vehicle.sent[-1] == "left"


def test_a_stop_a_late_command_and_a_sending_that_was_held_up_do_not_wait_for_the_period(
    monkeypatch,
):
    monkeypatch.setattr(streamed, "PERIOD_S", 0.6)
    late_s = time.monotonic() + 0.2
    with contextlib.closing(Sender(late_s=late_s)) as vehicle:
        wait_until(lambda: len(vehicle.sent) == 2, "one more, at the command's end")
        assert vehicle.sent[1] >= late_s
        vehicle.brake(0.0)
        wait_until(lambda: len(vehicle.sent) == 3, "one more, for the brake", 0.3)
        wait_until(lambda: len(vehicle.sent) == 4, "the next")
        assert vehicle.sent[3] - vehicle.sent[0] < 1.1  # when it was due without the two
    with contextlib.closing(Sender(pause_s=0.7)) as vehicle:
        wait_until(lambda: len(vehicle.sent) >= 2, "the next")
        assert vehicle.sent[1] - vehicle.sent[0] < 1.1  # its period would have come after 1.2 s


def test_each_new_state_is_logged_once_and_a_brake_latches(monkeypatch):
    monkeypatch.setattr(log, "event", events := Mock())
    with contextlib.closing(Sender()) as vehicle:
        vehicle.enable(0.0)
        vehicle.brake(0.0)
        for vehicle._core.words in ("why", "why", ""):
            vehicle.feedback(0.0)
        vehicle._core.state = VehicleState.DISABLED
    once = [call("warning", vehicle.name, state="stopped", why="why")]
    assert events.mock_calls == [*once, call("info", vehicle.name, state="stopped", why="")]


@pytest.mark.parametrize(("most_s", "stands_s"), [(60.0, 0.2), (0.2, math.inf)])
def test_the_end_waits_for_a_stand_and_the_stream_but_not_for_ever(monkeypatch, most_s, stands_s):
    monkeypatch.setattr(streamed, "STOP_TAKES_S", most_s)
    began_s, vehicle = time.monotonic(), Sender()
    monkeypatch.setattr(vehicle._core, "is_at_rest", lambda now_s: now_s >= began_s + stands_s)
    vehicle.close()
    assert 0.2 <= time.monotonic() - began_s < 30.0
    vehicle.close()
    assert (vehicle.sent.count("left"), vehicle.sent[-1]) == (1, "left")
