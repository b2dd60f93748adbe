"""The ROS 2 driver: first in made-up time, then on real Zenoh sessions, against rosbags."""

import contextlib
import math
import time

import pytest
from hil_tests.processes import wait_until
from hil_tests.testing.edge import Simulator, run_edge
from hil_tests.testing.vehicles import CONGESTION, LEFT_TURN, PEDAL, STREAM_S, Ros2Rig

from edge_runtime.reach import free_endpoint
from edge_runtime.tests.ros2_side import RosHunter
from edge_runtime.util import UserError
from edge_runtime.vehicles.core import VehicleState
from edge_runtime.vehicles.plausibility import Fault
from edge_runtime.vehicles.ros2 import (
    STEERING,
    YAW_RATE,
    Motion,
    Ros2Core,
    Ros2Settings,
    Ros2Vehicle,
    drive_of,
    twist_of,
)


def test_only_odometry_confirms_it_and_without_any_it_stops_and_says_so():
    rig = Ros2Rig()
    rig.talks = False
    rig.core.enable(rig.now_s)
    rig.step(25, PEDAL)
    assert rig.sent[-1][1] == Motion(0.0, 0.0)
    rig.step(30)
    assert rig.core.state is VehicleState.STOPPED
    assert rig.words == ["no odometry on odom within 1 s", "no fresh odometry on odom"]
    assert rig.report.standing == ["no fresh odometry on odom"]
    rig.talks = True
    rig.enabled().step(55, PEDAL)
    assert rig.speed_mps > 0.5


def test_odometry_that_repeats_itself_is_silence():
    rig = Ros2Rig().driving()
    rig.talks = False
    for _ in range(15):
        rig.core.hear(round(100 * 1e9), 0.5, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert (rig.core.cause, rig.words[0]) == (Fault.SILENT, "no fresh odometry on odom")


def test_a_clock_set_back_counts_after_the_next_enable():
    rig = Ros2Rig().enabled()
    rig.core.hear(5, 0.0, 0.0, rig.now_s)
    assert rig.core.stale == 1
    rig.core.enable(rig.now_s)
    rig.core.hear(6, 0.0, 0.0, rig.now_s)
    assert rig.core.state is VehicleState.ENABLED


def test_a_clock_set_back_is_believed_once_nothing_is_driven():
    rig = Ros2Rig().driving()
    rig.talks = False
    for tick in range(1, 40):
        rig.core.hear(tick, 0.0, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert rig.core.cause is Fault.SILENT
    assert rig.core.standing(rig.now_s) == []  # Else no re-arm would ever be taken.


def test_odometry_without_stamps_is_believed_by_its_arrival():
    core = Ros2Core(Ros2Settings(), LEFT_TURN)
    core.enable(0.0)
    for tick in range(20):
        core.hear(0, 0.1, 0.0, tick * STREAM_S)
        core.tick(tick * STREAM_S)
    assert core.state is VehicleState.ENABLED


@pytest.mark.parametrize("angular", [YAW_RATE, STEERING])
def test_the_steering_comes_back_from_the_odometry(angular):
    rig = Ros2Rig("congestion", odometry_angular=angular).enabled()
    for count, wheels, found in ((150, None, 0.5), (5, 0.0, 0.0)):  # then it goes straight
        rig.angular = wheels
        rig.step(count, {"steering": 0.5}, scenario_speed_mps=4.0)
        assert rig.report.action["steering"] == pytest.approx(found, abs=1e-6)


def test_an_angle_that_no_wheel_has_is_not_believed():
    """1.3 times full lock, as of the inner wheel: some drivers report that one."""
    for angular, believed in ((0.748, True), (-0.748, True), (0.749, False), (-0.749, False)):
        rig = Ros2Rig(odometry_angular=STEERING)
        rig.core.enable(rig.now_s)
        rig.angular = angular
        rig.step(2)
        assert rig.core.state is (VehicleState.ENABLED if believed else VehicleState.STOPPED)
        assert rig.core.cause is (None if believed else Fault.LYING)


def test_at_a_stand_a_yaw_rate_tells_nothing_and_the_asked_steering_is_reported():
    rig = Ros2Rig("congestion").enabled()
    rig.obeys = False
    rig.step(25, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert rig.report.action["steering"] == pytest.approx(0.5, abs=1e-6)


def test_a_twist_by_hand():
    """1 m/s on a circle of 2 m: 0.5 rad/s, and an angle of atan(0.65 / 2) as hunter_ros2 has it."""
    motion = Motion(1.0, math.atan(0.65 / 2.0))
    twist = twist_of(motion, YAW_RATE, 0.65)
    assert (twist.linear.x, twist.angular.z) == pytest.approx((1.0, 0.5))
    assert twist_of(motion, STEERING, 0.65).angular.z == motion.centre_rad
    drive = drive_of(motion, 3 * 10**9 + 4)
    assert (drive.drive.speed, drive.drive.steering_angle) == (1.0, motion.centre_rad)
    assert (drive.header.stamp.sec, drive.header.stamp.nanosec) == (3, 4)


# On real sessions.


@pytest.fixture
def make(monkeypatch):
    """Makes vehicles, closed with the test: an open session would hang the process."""
    monkeypatch.setattr(Ros2Vehicle, "control_period_s", 0.1)
    with contextlib.ExitStack() as made:
        yield lambda similarity=LEFT_TURN, **changes: made.enter_context(
            contextlib.closing(Ros2Vehicle(Ros2Settings(**changes), similarity))
        )


def test_both_kinds_of_command_below_a_namespace_and_their_tokens(make):
    """At a bridge that listens; in the last test it connects."""
    endpoint = free_endpoint()
    topics = {"namespace": "/robot", "ackermann_topic": "ackermann_cmd"}
    with RosHunter(listen=endpoint, namespace="robot") as hunter:
        vehicle = make(CONGESTION, connect=endpoint, **topics)

        def turns():
            if vehicle.state in (
                VehicleState.DISABLED,
                VehicleState.STOPPED,
            ):  # Or while this machine paused.
                vehicle.enable(time.monotonic())
            vehicle.command({"steering": -1.0}, time.monotonic(), scenario_speed_mps=4.0)
            at_speed = hunter.drives and hunter.drives[-1]["drive"]["speed"] > 0.99
            report = vehicle.feedback(time.monotonic())
            return at_speed and report.action["steering"] == pytest.approx(-1.0, abs=0.01)

        wait_until(turns, "the turn")
        # -1 turns left. What hunter_ros2 makes of speed and yaw rate is the inner wheel's angle.
        assert 0 < hunter.drives[-1]["drive"]["steering_angle"] < hunter.inner_rad
        chunks = sorted("/".join(token.split("/")[3:5]) for token in hunter.tokens)
        assert chunks == ["", "MP/robot§ackermann_cmd", "MP/robot§cmd_vel", "MS/robot§odom"]
        vehicle.close()  # Zeros go out until it stands.
        wait_until(lambda: not hunter.tokens, "the tokens to go")
        assert hunter.speed_mps < 0.1
        assert [twist["linear"]["x"] for twist in hunter.twists[-5:]] == [0.0] * 5


@pytest.mark.parametrize("enables", [False, True])
def test_it_closes_twice_and_without_having_been_enabled(make, enables):
    vehicle = make(listen=free_endpoint())
    if enables:
        vehicle.enable(time.monotonic())
    vehicle.close()
    vehicle.close()
    vehicle.enable(time.monotonic())
    assert vehicle.state is VehicleState.DISABLED


def test_a_busy_port_is_one_line_with_the_settings_name(make):
    busy = free_endpoint()
    with RosHunter(listen=busy), pytest.raises(
        UserError, match=r"another with \[vehicle.ros2\] listen$"
    ):
        make(listen=busy)


def test_it_drives_and_stops_when_the_odometry_falls_silent(make_policy, tmp_path):
    endpoint, ros_endpoint, settings = free_endpoint(), free_endpoint(), tmp_path / "edge.toml"
    topics = "twist_topic = '/cmd_vel'\nodometry_topic = '/odom'\nnamespace = '/any'"
    settings.write_text(
        f"vehicle.driver = 'ros2'\n[vehicle.ros2]\nlisten = '{ros_endpoint}'\n{topics}"
    )
    flags = [*make_policy(value=1.0).flags, "--connect", endpoint, "--config", str(settings)]
    with Simulator(endpoint) as simulator, run_edge(*flags) as edge, RosHunter(
        connect=ros_endpoint
    ) as hunter:
        simulator.wait_for_edge()
        wait_until(lambda: len(hunter.twists) > 10, "zeros")
        assert hunter.asked_mps == 0.0
        # Nobody may have been there for the first enabling.
        simulator.drive_until(lambda: hunter.speed_mps > 0.5, "the Hunter to drive", rearms=True)
        wait_until(lambda: simulator.feedback[-1].speed_mps > 0.3, "its feedback")
        feedback = simulator.feedback[-1]
        assert feedback.vehicle == "ros2"
        assert feedback.scenario_speed_mps == pytest.approx(4 * feedback.speed_mps)
        hunter.silent = True
        silence = "no fresh odometry on /odom"
        simulator.drive_until(
            lambda: silence in simulator.feedback[-1].faults, "the fault in words"
        )
        assert hunter.asked_mps == 0.0
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0
