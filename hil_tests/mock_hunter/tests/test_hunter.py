"""The mock chassis. Its frames are written by hand: to agree with our codec proves little."""

import itertools
import math
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter.protocol import MotionCommand
from edge_runtime.vehicles.mapping import SPECS
from hil_tests.mock_hunter import chassis as rules
from hil_tests.mock_hunter.chassis import ChassisCondition, ChassisEvent, Control
from hil_tests.mock_hunter.hunter import (
    MODELS,
    Body,
    MockHunter,
    advance,
    curvature,
    make_parameters,
)
from hil_tests.testing.commands import render_table

TIMEOUT_S = 0.5
REMOTE = {Control.REMOTE, Control.REMOTE_OVER_CAN}
DRIVING = rules.Chassis(Control.CAN, brake_locked=False, commanded_s=0.0)


def test_these_and_no_others_lead_to_can_control_from_outside():
    """Anything else that gave control to the bus would be a way to move without being asked."""
    found = set()
    for state, event in itertools.product(Control, rules.CONTROL):
        after = rules.advance(DRIVING._replace(control=state), event)
        if after.control is Control.CAN and state is not Control.CAN:
            found.add((state, event))
        if state in REMOTE or event in (ChassisEvent.REMOTE_ON, ChassisEvent.REMOTE_OFF):
            assert (after.control in REMOTE) == (event is not ChassisEvent.REMOTE_OFF)
    assert found == {
        (Control.STANDBY, ChassisEvent.CAN_MODE),
        (Control.LINK_LOST, ChassisEvent.CAN_MODE),
        (Control.LINK_LOST, ChassisEvent.COMMAND),
        (Control.REMOTE_OVER_CAN, ChassisEvent.REMOTE_OFF),
    }


def test_the_bus_drives_only_in_can_control_without_errors_and_brake():
    every = itertools.product(Control, ChassisCondition, (False, True))
    drives = [each for each in every if rules.obeys(rules.Chassis(*each))]
    assert drives == [(Control.CAN, ChassisCondition.OK, False)]


def test_can_mode_starts_its_own_time_and_does_not_prolong_it():
    taken = rules.take_can_mode(rules.Chassis(brake_locked=False, commanded_s=1.0), 9.0)
    assert rules.take_time(taken, 9.5, TIMEOUT_S).control is Control.CAN
    again = rules.take_can_mode(taken, 9.4)
    assert rules.take_time(again, 9.501, TIMEOUT_S).control is Control.LINK_LOST
    kept = rules.take_command(DRIVING, 0.4)
    assert rules.take_time(kept, 0.9, TIMEOUT_S).control is Control.CAN


def test_an_emergency_stop_and_errors_go_one_by_one():
    chassis = rules.advance(rules.take_cause(DRIVING, "driver", True), ChassisEvent.ESTOP_ON)
    assert chassis.condition is ChassisCondition.ESTOP_AND_EXCEPTION
    released = rules.advance(chassis, ChassisEvent.ESTOP_OFF)
    assert released.condition is ChassisCondition.EXCEPTION
    healed = rules.take_clear(rules.take_cause(chassis, "driver", False))
    assert healed.condition is ChassisCondition.ESTOP
    both = rules.take_cause(rules.take_cause(DRIVING, "link_steer", True), "undervoltage", True)
    one = rules.take_cause(both, "link_steer", False)
    assert not rules.obeys(one)
    assert rules.obeys(rules.take_cause(one, "undervoltage", False))


@pytest.mark.parametrize(
    ("table", "kind"), [(rules.CONTROL, Control), (rules.CONDITION, ChassisCondition)]
)
def test_the_tables_stand_in_the_readme_and_every_pair_of_state_and_event_in_one(table, kind):
    assert [*rules.CONTROL, *rules.CONDITION] == list(ChassisEvent)
    states = list(kind)
    assert {len(row) for row in table.values()} == {len(states)}
    shown = render_table(table, states, lambda state, event: table[event][states.index(state)])
    assert shown in Path(rules.__file__).with_name("README.md").read_text()


P = MODELS["hunter-2.0"]
setpoints = st.builds(MotionCommand, st.floats(-3, 3), st.floats(-1, 1))
bodies = st.builds(
    Body, st.floats(-P.max_speed_mps, P.max_speed_mps), st.floats(-P.max_inner_rad, P.max_inner_rad)
)
steps_s = st.floats(0.001, 0.02)


@given(bodies, st.none() | setpoints, steps_s)
def test_nothing_leaps_no_limit_is_passed_and_the_speed_comes_closer(body, setpoint, step_s):
    after = advance(body, setpoint, step_s, P)
    assert abs(after.speed_mps) <= P.max_speed_mps + 1e-12
    assert abs(after.inner_rad) <= P.max_inner_rad + 1e-12
    fastest = max(P.acceleration_mps2, P.braking_mps2)
    assert abs(after.speed_mps - body.speed_mps) <= fastest * step_s + 1e-12
    turned_rad = abs(after.inner_rad - body.inner_rad)
    assert turned_rad <= (P.steering_rate_radps * step_s + 1e-12 if setpoint else 0.0)
    asked_mps = 0.0 if setpoint is None else setpoint.speed_mps
    wanted_mps = min(max(asked_mps, -P.max_speed_mps), P.max_speed_mps)
    before_gap, gap = wanted_mps - body.speed_mps, wanted_mps - after.speed_mps
    assert abs(gap) <= abs(before_gap) + 1e-12
    assert before_gap * gap >= -1e-12  # it never overshoots


def settle(setpoint, seconds, body=None, step_s=0.005):
    body = body or Body()
    for _ in range(round(seconds / step_s)):
        body = advance(body, setpoint, step_s, P)
    return body


def test_speed_covers_63_percent_in_its_time_constant_and_the_steering_turns_at_its_rate():
    small = 0.05  # below the rate limit, so that the lag alone is seen
    slow = settle(MotionCommand(small, 0.0), P.speed_time_constant_s)
    assert slow.speed_mps == pytest.approx(small * (1 - math.exp(-1)), rel=1e-9)
    turned_rad = settle(MotionCommand(0.0, 0.5), 0.3).inner_rad
    assert turned_rad == pytest.approx(0.3 * P.steering_rate_radps, rel=1e-9)


def test_the_path_of_an_inner_angle_by_hand_and_its_outer_wheel_covers_more():
    """tan(0.4) = 0.42279; radius = 0.65 / 0.42279 + 0.605 / 2 = 1.83990 m."""
    radius_m, half_m = 1.83990, P.track_m / 2
    assert 1 / curvature(0.4, P) == pytest.approx(radius_m, abs=1e-4)
    assert (curvature(-0.4, P), curvature(0.0, P)) == (-curvature(0.4, P), 0.0)
    body = settle(MotionCommand(1.0, 0.4), 2.0, settle(MotionCommand(0.0, 0.4), 1.0))
    assert body.right_m > body.left_m > 0  # a turn to the left
    ratio = (radius_m + half_m) / (radius_m - half_m)
    assert body.right_m / body.left_m == pytest.approx(ratio, abs=1e-4)


@pytest.mark.parametrize(("model", "name"), [("hunter-2.0", "2.0"), ("hunter-se", "se")])
def test_the_drivers_own_table_agrees(model, name):
    mine, its = MODELS[model], SPECS[name]
    assert (mine.max_speed_mps, mine.max_inner_rad, mine.wheelbase_m, mine.track_m) == (
        its.max_speed_mps, its.max_inner_steering_rad, its.wheelbase_m, its.track_m,
    )  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [{"wings": 1.0}, {"track_m": 0.0}, {"dead_time_s": -0.1}, {"braking_mps2": math.nan},
     {"braking_mps2": math.inf}],
)  # fmt: skip
def test_parameters_that_cannot_be_are_refused(changes):
    with pytest.raises(UserError, match=next(iter(changes))):
        make_parameters("hunter-2.0", changes)
    assert make_parameters("hunter-se", {"dead_time_s": 0.0}).dead_time_s == 0.0


CAN_MODE, STANDBY = (0x421, b"\x01"), (0x421, b"\x00")
RELEASE, LOCK = (0x131, b"\x00"), (0x131, b"\x01")
CLEAR = (0x441, b"\x00")
SLOW_AHEAD = (0x111, bytes.fromhex("00 96 00 00 00 00 00 00"))  # 0.15 m/s, golden
FAST_AHEAD = (0x111, bytes.fromhex("03 E8 00 00 00 00 00 00"))  # 1.0 m/s
TURNED = (0x111, bytes.fromhex("00 00 00 00 00 00 00 C8"))  # 0.2 rad, golden
STOP = (0x111, bytes(8))

FAULT_BITS = {  # byte, bit: from the facts, not from the driver
    "steering_encoder": (4, 1), "remote_lost": (4, 2), "driver": (4, 6), "undervoltage": (5, 0),
    "link_steer": (5, 3), "link_rear_right": (5, 4), "link_rear_left": (5, 5),
    "overtemperature": (5, 6), "overcurrent": (5, 7),
}  # fmt: skip


class Bench:
    """A mock with a clock of its own, polled every 5 ms."""

    def __init__(self, *frames):
        self.now_s = 100.0
        self.hunter = MockHunter(P, self.now_s)
        self.seen = []
        self.send(*frames)

    def send(self, *frames):
        for can_id, data in frames:
            self.hunter.receive(can_id, data, self.now_s)

    def run(self, seconds, frame=None):
        """Let time pass; with a frame, it is streamed at 50 Hz."""
        for step in range(round(seconds / 0.005)):
            if frame is not None and step % 4 == 0:
                self.send(frame)
            self.now_s = round(self.now_s + 0.005, 6)
            if self.now_s >= self.hunter.next_s:
                due = self.hunter.due(self.now_s)
                self.seen += [(self.now_s, frame.can_id, data) for frame, data in due]
        return self

    def switch(self, name, on=True):
        self.hunter.switch(name, on, self.now_s)

    def sent(self, can_id):
        return [data for _, sent_id, data in self.seen if sent_id == can_id]

    def times(self, can_id, since_s=0.0):
        return [at for at, sent_id, _ in self.seen if sent_id == can_id and at > since_s]

    @property
    def stands(self):
        return self.hunter.body.stands

    @property
    def status(self):
        return self.sent(0x211)[-1]


def enabled(frame=FAST_AHEAD, seconds=2.0):
    return Bench(CAN_MODE, RELEASE).run(seconds, frame)


def test_power_on_by_hand():
    first = Bench().run(0.05)
    # ok, standby, some 28.0 V, no fault, brake locked, the first one counted.
    assert (first.status[:2], first.status[4:]) == (b"\x00\x00", b"\x00\x00\x01\x00")
    assert 270 <= int.from_bytes(first.status[2:4], "big") <= 280
    assert first.sent(0x221)[-1] == bytes(8)


@pytest.mark.parametrize("frame", [SLOW_AHEAD, TURNED])
def test_the_documented_start_moves_it_by_the_golden_frames(frame):
    bench = enabled(frame)
    assert (bench.status[1], bench.status[6]) == (1, 0)
    assert bench.sent(0x221)[-1] == frame[1]


@pytest.mark.parametrize(
    "frames",
    [
        (), (CAN_MODE,), (RELEASE,), (CAN_MODE, RELEASE, LOCK), (CAN_MODE, RELEASE, STANDBY),
        ((0x421, b"\x02"), RELEASE), ((0x421, b"\x01\x00"), RELEASE), (CAN_MODE, (0x131, b"")),
    ],
)  # fmt: skip
def test_short_of_the_whole_start_nothing_moves(frames):
    assert Bench(*frames).run(1.0, FAST_AHEAD).stands


def test_periods_are_kept_on_absolute_deadlines_and_after_a_pause_it_reports_once():
    bench = enabled()
    periods_s = dict.fromkeys((0x211, 0x261, 0x262, 0x263), 0.1)
    periods_s |= dict.fromkeys((0x221, 0x251, 0x252, 0x253), 0.02)
    assert {sent_id for _, sent_id, _ in bench.seen} == set(periods_s)
    for can_id, period_s in periods_s.items():
        times = bench.times(can_id)
        assert len(times) == pytest.approx(2.0 / period_s, abs=1)
        assert times[-1] - times[0] == pytest.approx((len(times) - 1) * period_s, abs=0.006)
    counters = [data[7] for data in bench.sent(0x211)]
    assert counters == list(range(len(counters)))
    grid_s = bench.hunter.next_s
    sent = bench.hunter.due(grid_s + 1.013)
    assert len({frame.can_id for frame, _ in sent}) == len(sent)
    assert bench.hunter.next_s == pytest.approx(grid_s + 1.02)


def test_nothing_happens_within_the_dead_time():
    bench = Bench(CAN_MODE, RELEASE).run(P.dead_time_s, FAST_AHEAD)
    assert bench.hunter.body.speed_mps < P.acceleration_mps2 * 0.006
    assert bench.run(0.05, FAST_AHEAD).hunter.body.speed_mps > 0.05


def test_without_commands_it_stands_by_and_drives_on_by_itself_when_they_come_back():
    bench = enabled()
    assert not bench.run(0.45).stands
    bench.run(0.15)
    assert (bench.status[1], bench.status[4]) == (0, 1 << 4)
    assert bench.run(1.0).stands
    assert bench.run(1.0, FAST_AHEAD).hunter.body.speed_mps > 0.8
    assert (bench.status[1], bench.status[4:6]) == (1, b"\x00\x00")


@pytest.mark.parametrize("name", rules.BITS)
def test_each_error_by_hand_stops_and_goes_as_its_row_says(name):
    bench, row = enabled(), rules.BITS[name]
    bench.switch(name)
    bench.run(1.0, FAST_AHEAD)
    data, (byte, bit) = bench.status, FAULT_BITS[name]
    assert (data[byte], data[9 - byte]) == (1 << bit, 0)  # in one of bytes 4 and 5
    assert data[0] == (2 if row.stops else 0)
    assert bench.stands == row.stops
    bench.send(CLEAR)
    assert bench.hunter.chassis.errors == {name}  # the cause is still there
    bench.switch(name, on=False)
    assert bench.hunter.chassis.errors == ({name} if row.latches else set())
    assert rules.obeys(bench.hunter.chassis) == (not (row.latches and row.stops))
    bench.send(CLEAR)
    assert not bench.run(1.0, FAST_AHEAD).stands
    assert bench.status[4:6] == b"\x00\x00"


def test_undervoltage_is_in_the_battery_and_its_motors_say_so():
    bench = enabled()
    bench.switch("undervoltage")
    bench.run(0.2, SLOW_AHEAD)
    assert int.from_bytes(bench.status[2:4], "big") < 220
    for can_id in (0x261, 0x262, 0x263):
        data = bench.sent(can_id)[-1]
        assert (data[:2], data[5] & 1) == (bench.status[2:4], 1)


@pytest.mark.parametrize(
    ("name", "byte", "shown"), [("estop", 0, 1), ("remote", 1, 2), ("brake", 6, 1)]
)
def test_a_person_and_the_brake_outrank_the_bus_and_give_control_back(name, byte, shown):
    bench = enabled()
    bench.send(LOCK) if name == "brake" else bench.switch(name)
    bench.send(CAN_MODE)
    assert bench.run(0.75, FAST_AHEAD).stands
    assert bench.status[byte] == shown
    bench.send(RELEASE) if name == "brake" else bench.switch(name, on=False)
    assert not bench.run(0.5, FAST_AHEAD).stands


def test_silent_it_obeys_and_off_the_bus_it_hears_nothing_either():
    bench = enabled(SLOW_AHEAD)
    count = len(bench.seen)
    bench.switch("silent")
    assert bench.run(1.0, FAST_AHEAD).hunter.body.speed_mps > 0.8
    bench.switch("bus_off")
    assert bench.run(1.5, FAST_AHEAD).stands
    assert bench.hunter.chassis.control is Control.LINK_LOST
    assert len(bench.seen) == count


def test_back_on_the_bus_it_does_not_drive_what_it_last_heard():
    """A multicast bus brings its own reports back to it, before the first new command."""
    bench = enabled()
    bench.switch("bus_off")
    bench.run(1.5, STOP)
    bench.switch("bus_off", on=False)
    bench.send((0x221, bytes(8)), (0x211, bytes(8)))
    where_m = bench.run(0.01).hunter.body.right_m
    assert bench.run(0.5, STOP).hunter.body.right_m == where_m
    assert bench.status[1] == 1  # the trap: it has control again


def test_late_its_reports_are_old_and_in_order():
    bench = enabled()
    bench.switch("late")
    begun_s = bench.now_s
    bench.run(1.0, STOP)
    assert bench.times(0x221, begun_s)[0] - begun_s == pytest.approx(rules.LATE_S, abs=0.03)
    bench.switch("late", on=False)
    bench.run(1.0, STOP)
    counters = [data[7] for data in bench.sent(0x211)]
    assert counters == sorted(counters)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_single_frame_moves_it_out_of_standby(can_id, data):
    assert Bench((can_id, data)).run(0.2, (can_id, data)).stands


happenings = st.lists(
    st.one_of(
        st.sampled_from([CAN_MODE, STANDBY, RELEASE, LOCK, CLEAR, FAST_AHEAD, TURNED, STOP]),
        st.tuples(st.sampled_from(sorted(set(rules.FAULTS) - {"stuck"})), st.booleans()),
        st.floats(0.005, 0.3),
    ),
    max_size=30,
)


@settings(max_examples=60)
@given(happenings)
def test_whatever_happens_it_keeps_its_limits_and_brakes_where_it_does_not_obey(happened):
    bench = Bench(CAN_MODE, RELEASE, FAST_AHEAD)
    for one in happened:
        if isinstance(one, float):
            bench.run(one, FAST_AHEAD)
        elif isinstance(one[1], bool):
            bench.switch(*one)
        else:
            bench.send(one)
        assert abs(bench.hunter.body.speed_mps) <= P.max_speed_mps
    bench.run(2.0)  # the commands cease
    assert bench.stands
    assert not rules.obeys(bench.hunter.chassis)


def test_pulses_count_the_way():
    bench = enabled(seconds=3.0)
    per_m = P.motor_revolutions_per_m * P.pulses_per_revolution
    for can_id, way_m in ((0x252, bench.hunter.body.right_m), (0x253, bench.hunter.body.left_m)):
        rpm, _, pulses = struct.unpack(">hhi", bench.sent(can_id)[-1])
        assert pulses == pytest.approx(way_m * per_m, abs=0.03 * per_m)
        assert rpm == pytest.approx(60 * P.motor_revolutions_per_m, rel=0.02)
