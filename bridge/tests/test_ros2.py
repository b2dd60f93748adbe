"""Our messages as ROS 2 messages: by hand, and over their whole range."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import signal
import time
from collections import defaultdict
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from bridge.messages import Heard
from bridge.ros2 import (
    UNKNOWN,
    DeadReckoning,
    Outlet,
    Policies,
    Policy,
    drive_of,
    image_of,
    odometry_of,
    twist_of,
)
from bridge.tests import harness
from bridge.tests.harness import (
    SLOW_TOY,
    BridgeProcess,
    make_policy,
    read,
    start_edge,
    start_simulate,
)
from edge_runtime.tests import ros2_side
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import CARS
from edge_runtime.vehicles.ros2 import topic_key
from edge_runtime.wire import encode

PEDAL = Policy(["pedal"], CARS["left_turn"])
STEERING = Policy(["steering"], CARS["congestion"])
S = 10**9


def make_command(*action):
    return harness.make_command(1, action=list(action), sent_ns=3 * S + 5)


def make_feedback(speed_mps, *action, sent_ns=0):
    return harness.make_feedback(1, speed_mps=speed_mps, action=list(action), sent_ns=sent_ns)


def test_the_newer_frame_is_shown():
    image = image_of(make_state(1, frames=bytes([1]) * 3600 + bytes([2]) * 3600, sent_ns=2 * S + 7))
    assert image.data == bytes([2]) * 3600
    assert (image.header.stamp.sec, image.header.stamp.nanosec) == (2, 7)


@pytest.mark.parametrize(
    ("pedal", "now_mps", "speed", "acceleration"),
    [(1.0, 2.0, 2.3, 3.0), (-1.0, 2.0, 1.6, 4.0), (-1.0, 0.1, 0.0, 4.0), (1.0, 5.9, 6.0, 3.0)],
)
def test_a_pedal_is_the_speed_at_the_end_of_the_period(pedal, now_mps, speed, acceleration):
    drive = drive_of(make_command(pedal), now_mps, PEDAL).drive
    assert (drive.speed, drive.acceleration) == pytest.approx((speed, acceleration))
    assert drive.steering_angle == 0.0


def test_steering_to_the_right_is_negative_and_keeps_the_speed():
    """Congestion's +1 turns right, by 0.15 rad at a bicycle that turns about its centre."""
    stamped = drive_of(make_command(1.0), 5.0, STEERING)
    assert (stamped.drive.speed, stamped.drive.acceleration) == (5.0, 0.0)
    curvature = -math.sin(math.atan(0.5 * math.tan(0.15))) / 2.5
    assert stamped.drive.steering_angle == pytest.approx(math.atan(5.0 * curvature))
    twist = twist_of(stamped.drive, STEERING.car)
    assert twist.linear.x == 5.0
    assert twist.angular.z == pytest.approx(5.0 * curvature)


@given(st.floats(-1, 1), st.floats(0, 20))
def test_no_command_asks_for_more_than_the_car_can(value, speed_mps):
    for policy in (PEDAL, STEERING):
        drive = drive_of(make_command(value), speed_mps, policy).drive
        assert 0.0 <= drive.speed <= 6.0
        assert abs(drive.steering_angle) < math.pi / 2
        assert math.isfinite(twist_of(drive, policy.car).angular.z)


def test_an_action_more_or_less_than_the_policys_names_is_taken_as_none():
    assert drive_of(make_command(0.5, 0.5), 1.0, PEDAL).drive.steering_angle == 0.0
    assert PEDAL.action([], "pedal") is None


def test_a_circle_of_dead_reckoning_ends_where_it_began():
    pose = DeadReckoning()
    # 2 pi m at 1 m/s around a circle of 1 m to the left, in 100 steps.
    for step in range(101):
        pose.advance(1.0, 1.0, round(step * math.tau / 100 * S))
        if step == 25:
            assert (pose.x_m, pose.y_m) == pytest.approx((1.0, 1.0), abs=1e-6)
            assert pose.yaw_rad == pytest.approx(math.pi / 2)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert pose.way_m == pytest.approx(math.tau)


def test_a_gap_and_a_clock_that_goes_back_invent_no_way():
    pose = DeadReckoning()
    for time_ns in (100 * S, 50 * S, 50 * S):
        pose.advance(2.0, 0.0, time_ns)
    assert pose.way_m == 0.0
    pose.advance(2.0, 0.0, 5000 * S)
    assert pose.x_m == pytest.approx(1.0)  # half a second's, not 83 minutes'


def test_the_odometry_says_what_it_does_not_know():
    pose = DeadReckoning()
    pose.advance(1.0, 0.0, 0)
    pose.advance(1.0, 0.0, S // 2)
    unsteered = odometry_of(make_feedback(1.0, 0.5), pose, PEDAL.curvature([0.5]))
    assert unsteered.pose.covariance[7] == unsteered.pose.covariance[35] == UNKNOWN
    assert unsteered.pose.covariance[0] == pytest.approx(0.05**2)
    steered = make_feedback(1.0, -1.0)
    curvature = STEERING.curvature(steered.action, 0.25)
    assert curvature is not None
    assert curvature > 0  # to the left
    message = odometry_of(steered, pose, curvature)
    assert message.twist.twist.angular.z == pytest.approx(curvature)
    assert message.pose.covariance[35] == pytest.approx(0.05**2)


class FakeNode:
    """Where an Outlet would publish to: what was published, by topic."""

    def __init__(self):
        self.published = defaultdict(list)

    def publisher(self, topic, _kind):
        topic_key("/x", topic)
        return self.published[topic].append


def heard(topic, payload, at_s=0.0):
    return Heard(f"phil/x/{topic}", topic, payload, round(at_s * S), len(payload))


def outlet_with(status, rate_hz=20.0):
    node: Any = FakeNode()
    return node, Outlet(node, Policies(status, clock_s=lambda: 0.0), rate_hz)


def status_of(scenario, *names):
    manifest = {"scenario": scenario, "action": [{"name": name} for name in names]}
    return lambda: {"policy_id": "p", "manifest": manifest}


left_turn_status = status_of("left_turn", "pedal")
congestion_status = status_of("congestion", "steering")


def nobody():
    raise UserError("nobody")


def test_what_cannot_be_read_is_counted_by_topic_and_reason():
    node, outlet = outlet_with(left_turn_status)
    for topic in ("state", "command", "feedback", "health", "scene", "alive"):
        outlet.take(heard(topic, b"\xc1"))
    topics = ("state", "command", "feedback")
    assert outlet.rejected == {f"{topic}_malformed": 1 for topic in topics}
    assert not any(node.published.values())


def test_commands_are_shown_once_the_edge_says_whose_they_are():
    node, outlet = outlet_with(left_turn_status)
    outlet.take(heard("command", encode(make_command(1.0))))
    (drive,) = node.published["command/ackermann"]
    assert drive.drive.acceleration == 3.0
    node, outlet = outlet_with(nobody)
    outlet.take(heard("command", encode(make_command(1.0))))
    assert outlet.rejected == {"command_unknown_policy": 1}


def test_a_policy_of_an_unknown_car_is_said_once(capsys):
    _, outlet = outlet_with(status_of("parking"))
    for _ in range(2):
        outlet.take(heard("command", encode(make_command(1.0))))
    assert capsys.readouterr().err.count("'parking' is not known") == 1


@pytest.mark.parametrize(("scenario_mps", "scale"), [(None, 1.0), (4.0, 0.25)])
def test_the_vehicles_scale_is_its_speed_over_the_scenarios(scenario_mps, scale):
    """The Hunter's path is four times as curved as the car's; a stand says nothing of the scale."""
    node, outlet = outlet_with(congestion_status)
    outlet.take(heard("command", encode(make_command(0.0))))
    for speed_mps in (1.0, 0.0, 1.0):
        feedback = structs.replace(
            make_feedback(speed_mps, -1.0),
            scenario_speed_mps=None if scenario_mps is None else scenario_mps * speed_mps,
        )
        outlet.take(heard("feedback", encode(feedback), at_s=len(node.published["odom"])))
    car_curvature = STEERING.curvature([-1.0])
    yaw_rates = [message.twist.twist.angular.z for message in node.published["odom"]]
    assert yaw_rates == pytest.approx([car_curvature / scale, 0.0, car_curvature / scale])


def test_a_flood_is_bounded_and_the_pose_still_right():
    node, outlet = outlet_with(left_turn_status, rate_hz=10.0)
    for step in range(201):  # 2 s at 100 Hz and 1 m/s
        feedback = make_feedback(1.0, 0.0, sent_ns=step * S // 100)
        outlet.take(heard("feedback", encode(feedback), at_s=step / 100))
    assert 20 <= len(node.published["odom"]) <= 22
    assert outlet.skipped == {"feedback": 201 - len(node.published["odom"])}
    assert node.published["odom"][-1].pose.pose.position.x == pytest.approx(2.0, abs=0.11)
    assert json.dumps(outlet.skipped)


class Listener:
    """A ROS 2 machine's bridge in its place: a session, its tokens, and rosbags to read with."""

    def __init__(self, endpoint):
        self.session = open_session(connect=endpoint, mode="router")
        self.tokens, self.heard = set(), defaultdict(list)
        tokens = ("@/*/@ros2_lv/**", self._token)
        self.declared = [self.session.liveliness().declare_subscriber(*tokens, history=True)]
        for name, type_name in {
            "image_raw": "sensor_msgs/msg/Image",
            "odom": "nav_msgs/msg/Odometry",
            "command/ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
            "command/twist": "geometry_msgs/msg/Twist",
        }.items():
            hear = functools.partial(self._hear, name, type_name)
            self.declared.append(self.session.declare_subscriber(f"hunter01/{name}", hear))

    def _token(self, sample):
        change = self.tokens.add if "PUT" in str(sample.kind) else self.tokens.discard
        change(str(sample.key_expr))

    def _hear(self, name, type_name, sample):
        self.heard[name].append(ros2_side.deserialize(type_name, sample.payload.to_bytes()))

    def close(self):
        for declared in self.declared:
            declared.undeclare()
        self.session.close()


def start_ros2(endpoint, ros_endpoint, *options):
    return BridgeProcess("ros2", "--connect", endpoint, "--ros2-listen", ros_endpoint, *options)


def test_a_drive_is_shown_to_ros_2_and_ends_with_the_simulator(tmp_path):
    endpoint, ros_endpoint, out = free_endpoint(), free_endpoint(), tmp_path / "ros2.json"
    policy = make_policy(tmp_path, "constant", 0.5)
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY, "--episodes", "2") as run,
        start_ros2(endpoint, ros_endpoint, "--out", str(out)) as shown,
        contextlib.closing(Listener(ros_endpoint)) as ros_side,
    ):
        assert shown.process.stdout.readline().startswith("ready vehicle_id=hunter01")
        wait_until(lambda: len(ros_side.tokens) == 5, "the tokens of four topics and the node")
        with start_edge(endpoint, policy, "--vehicle", "mock"):
            assert run.wait() == 0, run.errors
        assert shown.wait(20) == 0, shown.errors
        wait_until(lambda: not ros_side.tokens, "the tokens to go")
    assert len(ros_side.heard) == 4
    for image in ros_side.heard["image_raw"]:
        assert (image["height"], image["width"], image["step"]) == (45, 80, 80)
        assert image["encoding"] == "mono8"
        # The toy's picture is of one brightness.
        assert len(image["data"]) == 3600 == image["data"].count(image["data"][0])
    drives = [message["drive"] for message in ros_side.heard["command/ackermann"]]
    drives = [drive for drive in drives if drive["acceleration"] == pytest.approx(1.5)]
    assert drives  # half pedal of 3 m/s2; the others are the safe stop before and full brakes
    assert all(0.0 <= drive["speed"] <= 6.0 and drive["steering_angle"] == 0.0 for drive in drives)
    assert any(twist["linear"]["x"] > 0 for twist in ros_side.heard["command/twist"])
    ways = [message["pose"]["pose"]["position"]["x"] for message in ros_side.heard["odom"]]
    assert ways == sorted(ways)
    assert ways[-1] > 0
    report = read(out)
    assert report["sent"]["hunter01/odom"] >= len(ways)
    assert report["dropped"] == 0
    assert "sent: hunter01/image_raw" in shown.output


def test_a_sigterm_ends_it_with_its_counts(tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "counts.json"
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY),
        start_ros2(endpoint, free_endpoint(), "--out", str(out)) as shown,
    ):
        shown.process.stdout.readline()
        stranger = open_session(connect=endpoint, mode="client")
        sender = stranger.declare_publisher("phil/hunter01/feedback")
        wait_until(lambda: "true" in str(sender.matching_status), "a listener to feedback")
        for _ in range(5):
            sender.put(b"no map")
            time.sleep(0.1)
        stranger.close()
        shown.process.send_signal(signal.SIGTERM)
        assert shown.wait(20) == 0, shown.errors
    assert read(out)["rejected"]["feedback_malformed"] >= 1


def test_a_sigterm_is_an_interrupt_before_the_session_opens(monkeypatch, refusal):
    handlers = []

    def no_session(*_):
        handlers.append(signal.getsignal(signal.SIGTERM))
        raise UserError("none")

    monkeypatch.setattr("bridge.ros2.open_ros2_session", no_session)
    assert "none" in refusal("ros2")
    assert signal.SIG_DFL not in handlers


def test_a_busy_ros_2_port_names_the_option_to_change(refusal):
    busy = free_endpoint()
    session = open_session(listen=busy, mode="router")
    line = refusal("ros2", "--connect", free_endpoint(), "--ros2-listen", busy)
    session.close()
    assert "is in use" in line
    assert "--ros2-listen" in line
