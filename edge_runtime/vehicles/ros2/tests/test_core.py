"""The driver with made-up times: what it asks for, and what stops it."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edge_runtime.config import Ros2Settings
from edge_runtime.vehicles.core import COMMAND_TIMEOUT_S, ENABLE_TIMEOUT_S, Event, State
from edge_runtime.vehicles.ros2 import (
    ROS2_LEADS_TO,
    STEERING,
    YAW_RATE,
    Motion,
    Ros2Core,
)
from edge_runtime.vehicles.ros2.node import drive_of, twist_of
from edge_runtime.vehicles.ros2.tests.ros_hunter import CONGESTION, LEFT_TURN, SPEC, TICK_S, Drive


def test_nothing_is_sent_before_enable():
    drive = Drive()
    assert drive.run(0.5, {"pedal": 1.0}) is None
    assert drive.core.state is State.DISABLED


def test_it_drives_only_after_odometry_has_confirmed_it():
    drive = Drive()
    drive.sends_odometry = False
    drive.core.enable(drive.now_s)
    assert drive.run(0.5, {"pedal": 1.0}) == Motion(0.0, 0.0)
    drive.sends_odometry = True
    drive.run(0.1)
    assert drive.run(1.0, {"pedal": 1.0}).speed_mps > 0.5


def test_without_odometry_it_stops_and_says_so_in_words():
    drive = Drive()
    drive.sends_odometry = False
    drive.core.enable(drive.now_s)
    drive.run(ENABLE_TIMEOUT_S + 0.1)
    assert drive.core.state is State.STOPPED
    assert drive.report.faults == [
        "no odometry on odom within 1 s", "no fresh odometry on odom",
    ]  # fmt: skip
    assert drive.report.standing == ["no fresh odometry on odom"]


def test_a_pedal_is_integrated_to_the_vehicles_speed():
    """Full throttle: 3 m/s2 of the car, a quarter of it on the Hunter; its top speed in the end."""
    drive = Drive().start()
    assert drive.run(1.0, {"pedal": 1.0}).speed_mps == pytest.approx(0.75, abs=0.05)
    assert drive.run(3.0, {"pedal": 1.0}).speed_mps == SPEC.max_speed_mps
    assert drive.report.scenario_speed_mps == pytest.approx(6.0)
    assert drive.report.action["pedal"] == pytest.approx(0.0, abs=0.01)
    assert drive.run(1.0, {"pedal": -1.0}).speed_mps == pytest.approx(0.5, abs=0.05)
    assert drive.report.action["pedal"] == pytest.approx(-1.0, abs=0.15)


def test_a_policy_without_a_pedal_has_the_cars_speed_and_its_own_steering():
    drive = Drive(CONGESTION).start()
    motion = drive.run(3.0, {"steering": -1.0}, scenario_speed_mps=4.0)
    assert motion.speed_mps == pytest.approx(1.0)
    assert CONGESTION.centre_rad(-1.0) > 0  # -1 turns left
    assert motion.centre_rad == pytest.approx(CONGESTION.centre_rad(-1.0))


def stop_by_silence(drive):
    drive.sends_odometry = False
    drive.run(0.24, {"pedal": 1.0})


def stop_by_command_loss(drive):
    drive.run(COMMAND_TIMEOUT_S + 0.12)


def stop_by_brake(drive):
    drive.core.brake(drive.now_s)


def stop_by_lie(drive):
    drive.speed_mps, drive.obeys = 3.0, False
    drive.run(0.04, {"pedal": 1.0})
    drive.speed_mps, drive.obeys = 0.0, True


def stop_by_being_stuck(drive):
    drive.speed_mps, drive.obeys = 0.0, False
    drive.run(2.0, {"pedal": 1.0})
    drive.obeys = True


def stop_by_stale_odometry(drive):
    drive.sends_odometry = False
    for _ in range(15):
        drive.now_s += TICK_S
        drive.core.hear(round(100 * 1e9), 0.5, 0.0, drive.now_s)  # an old one, repeated
        drive.core.command({"pedal": 1.0}, drive.now_s)
        drive.motion = drive.core.tick(drive.now_s)


@pytest.mark.parametrize(
    ("stop", "cause", "words"),
    [
        (stop_by_silence, Event.SILENT, "no fresh odometry on odom"),
        (stop_by_command_loss, Event.COMMAND_LATE, "no command for 0.24 s"),
        (stop_by_brake, Event.BRAKE, None),
        (stop_by_lie, Event.LYING, "the odometry says 3.00 m/s"),
        (stop_by_being_stuck, Event.STUCK, "the speed stays at 0.00 m/s"),
        (stop_by_stale_odometry, Event.SILENT, "no fresh odometry on odom"),
    ],
)
def test_every_stop_latches_until_it_is_enabled_again(stop, cause, words):
    drive = Drive().start()
    drive.run(1.0, {"pedal": 1.0})
    stop(drive)
    assert drive.core.cause is cause
    faults = drive.report.faults
    assert not faults if words is None else faults[0].startswith(words)
    assert drive.report.self_braking
    # All is well again, and commands come: it stands nevertheless.
    drive.sends_odometry = True
    assert drive.run(2.0, {"pedal": 1.0}).speed_mps == 0.0
    assert drive.report.standing == []
    drive.core.enable(drive.now_s)
    drive.run(0.1)
    assert drive.run(1.0, {"pedal": 1.0}).speed_mps > 0.5
    assert drive.report.faults == []


def test_the_brake_at_an_episodes_end_does_not_latch():
    drive = Drive().start()
    drive.run(1.0, {"pedal": 1.0})
    drive.core.brake(drive.now_s, latch=False)
    assert drive.run(0.5).speed_mps == 0.0
    assert drive.run(0.5, {"pedal": 1.0}).speed_mps > 0.2


def test_a_clock_set_back_counts_after_the_next_enable():
    drive = Drive().start()
    drive.now_s += 0.02
    drive.core.hear(5, 0.0, 0.0, drive.now_s)
    assert drive.core.stale == 1
    drive.core.enable(drive.now_s)
    drive.core.hear(6, 0.0, 0.0, drive.now_s)
    assert drive.core.state is State.ENABLED


def test_odometry_without_stamps_is_believed_by_its_arrival():
    core = Ros2Core(Ros2Settings(), LEFT_TURN)
    core.enable(0.0)
    for tick in range(20):
        core.hear(0, 0.1, 0.0, tick * TICK_S)
        core.tick(tick * TICK_S)
    assert core.state is State.ENABLED


def test_a_command_that_is_not_finite_or_lacks_an_action_is_refused():
    drive = Drive().start()
    with pytest.raises(ValueError, match="not finite"):
        drive.core.command({"pedal": math.nan}, drive.now_s)
    with pytest.raises(ValueError, match="lacks an action"):
        drive.core.command({}, drive.now_s, 6.0)


@pytest.mark.parametrize("angular", [YAW_RATE, STEERING])
def test_the_steering_comes_back_from_the_odometry(angular):
    drive = Drive(CONGESTION, odometry_angular=angular).start()
    motion = drive.run(3.0, {"steering": 0.5}, scenario_speed_mps=4.0)
    drive.angular = motion.centre_rad
    if angular == YAW_RATE:
        drive.angular = motion.speed_mps * math.tan(motion.centre_rad) / SPEC.wheelbase_m
    drive.run(0.1, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert drive.report.action["steering"] == pytest.approx(0.5, abs=1e-6)
    drive.angular = 0.0  # it goes straight, whatever was asked
    drive.run(0.1, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert drive.report.action["steering"] == pytest.approx(0.0, abs=1e-6)


def test_at_a_stand_a_yaw_rate_tells_nothing_and_the_asked_steering_is_reported():
    drive = Drive(CONGESTION).start()
    drive.obeys = False
    drive.run(0.5, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert drive.report.action["steering"] == pytest.approx(0.5, abs=1e-6)


def test_a_twist_by_hand():
    """1 m/s on a circle of 2 m: 0.5 rad/s, and an angle of atan(0.65 / 2) as hunter_ros2 has it."""
    motion = Motion(1.0, math.atan(0.65 / 2.0))
    twist = twist_of(motion, YAW_RATE, 0.65)
    assert (twist.linear.x, twist.angular.z) == pytest.approx((1.0, 0.5))
    assert twist_of(motion, STEERING, 0.65).angular.z == motion.centre_rad
    drive = drive_of(motion, 3 * 10**9 + 4)
    assert (drive.drive.speed, drive.drive.steering_angle) == (1.0, motion.centre_rad)
    assert (drive.header.stamp.sec, drive.header.stamp.nanosec) == (3, 4)


def test_every_event_names_states_only_where_it_changes_something():
    assert set(ROS2_LEADS_TO) == set(Event)
    for leads in ROS2_LEADS_TO.values():
        assert all(before is not after for before, after in leads.items())
    into_enabled = {event for event in Event if State.ENABLED in ROS2_LEADS_TO[event].values()}
    out_of_stopped = {event for event in Event if State.STOPPED in ROS2_LEADS_TO[event]}
    assert into_enabled == {Event.CONFIRMED}
    assert out_of_stopped == {Event.ENABLE, Event.CLOSE}


WILD = st.floats(allow_nan=False, allow_infinity=False)
STEPS = st.one_of(
    st.tuples(st.just("enable")),
    st.tuples(st.just("brake"), st.booleans()),
    st.tuples(st.just("command"), WILD, WILD, st.one_of(st.none(), WILD)),
    st.tuples(st.just("hear"), st.integers(-10, 10**12), WILD, WILD),
    st.tuples(st.just("wait"), st.floats(0, 1)),
)


@example([("enable",), ("hear", 0, 0.0, 0.0), ("command", 6e307, 0.0, None)])  # inf * 0 s
@given(st.lists(STEPS, max_size=40))
def test_whatever_comes_it_stays_in_its_limits_and_stopped_means_stopped(steps):
    core, now_s, may_drive = Ros2Core(Ros2Settings(), CONGESTION), 0.0, False
    for name, *values in steps:
        if name == "enable":
            core.enable(now_s)
        elif name == "brake":
            core.brake(now_s, *values)
        elif name == "command":
            core.command({"pedal": values[0], "steering": values[1]}, now_s, values[2])
        elif name == "hear":
            core.hear(values[0], values[1], values[2], now_s)
        else:
            now_s += values[0]
        may_drive = core.state is State.ENABLED
        motion = core.tick(now_s)
        if motion is not None:
            assert 0.0 <= motion.speed_mps <= SPEC.max_speed_mps
            assert abs(motion.centre_rad) <= SPEC.max_inner_steering_rad
            assert may_drive or motion.speed_mps == 0.0
        report = core.report(now_s)
        assert all(-1.0 <= value <= 1.0 for value in report.action.values())
