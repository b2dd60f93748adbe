"""Our messages as ROS 2 messages: by hand, and over their whole range."""

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

from bridge import ros2
from bridge.messages import Heard
from bridge.tests import harness
from edge_runtime.tests import ros2_side
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import CARS
from edge_runtime.vehicles.ros2 import topic_key
from edge_runtime.wire import encode

PEDAL = ros2.Policy(["pedal"], CARS["left_turn"])
STEERING = ros2.Policy(["steering"], CARS["congestion"])
S = 10**9


def command(*action):
    return harness.make_command(1, action=list(action), sent_ns=3 * S + 5)


def feedback(speed_mps, *action, **changes):
    return harness.make_feedback(1, speed_mps=speed_mps, action=list(action), **changes)


def test_the_newer_frame_is_shown():
    frames = bytes([1]) * 3600 + bytes([2]) * 3600
    image = ros2.image_of(make_state(1, frames=frames, sent_ns=2 * S + 7))
    assert image.data == bytes([2]) * 3600
    assert (image.header.stamp.sec, image.header.stamp.nanosec) == (2, 7)


@pytest.mark.parametrize(
    ("pedal", "now_mps", "speed", "acceleration"),
    [(1.0, 2.0, 2.3, 3.0), (-1.0, 2.0, 1.6, 4.0), (-1.0, 0.1, 0.0, 4.0), (1.0, 5.9, 6.0, 3.0)],
)
def test_a_pedal_is_the_speed_at_the_end_of_the_period(pedal, now_mps, speed, acceleration):
    drive = ros2.drive_of(command(pedal), now_mps, PEDAL).drive
    assert (drive.speed, drive.acceleration) == pytest.approx((speed, acceleration))
    assert drive.steering_angle == 0.0


def test_steering_to_the_right_is_negative_and_keeps_the_speed():
    """Congestion's +1 turns right, by 0.15 rad at a bicycle that turns about its centre."""
    stamped = ros2.drive_of(command(1.0), 5.0, STEERING)
    assert (stamped.drive.speed, stamped.drive.acceleration) == (5.0, 0.0)
    curvature = -math.sin(math.atan(0.5 * math.tan(0.15))) / 2.5
    assert stamped.drive.steering_angle == pytest.approx(math.atan(5.0 * curvature))
    twist = ros2.twist_of(stamped.drive, STEERING.car)
    assert twist.linear.x == 5.0
    assert twist.angular.z == pytest.approx(5.0 * curvature)


@given(st.floats(-1, 1), st.floats(0, 20))
def test_no_command_asks_for_more_than_the_car_can(value, speed_mps):
    for policy in (PEDAL, STEERING):
        drive = ros2.drive_of(command(value), speed_mps, policy).drive
        assert 0.0 <= drive.speed <= 6.0
        assert abs(drive.steering_angle) < math.pi / 2
        assert math.isfinite(ros2.twist_of(drive, policy.car).angular.z)
    # An action of more or fewer numbers than the policy's names is taken as none.
    assert ros2.drive_of(command(0.5, 0.5), 1.0, PEDAL).drive.steering_angle == 0.0
    assert PEDAL.action([], "pedal") is None


def test_a_circle_of_dead_reckoning_ends_where_it_began():
    pose = ros2.DeadReckoning()
    # 2 pi m at 1 m/s around a circle of 1 m to the left, in 100 steps.
    for step in range(101):
        pose.advance(1.0, 1.0, round(step * math.tau / 100 * S))
        if step == 25:
            assert (pose.x_m, pose.y_m) == pytest.approx((1.0, 1.0), abs=1e-6)
            assert pose.yaw_rad == pytest.approx(math.pi / 2)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert pose.way_m == pytest.approx(math.tau)


def test_a_gap_and_a_clock_that_goes_back_invent_no_way():
    pose = ros2.DeadReckoning()
    for time_ns in (100 * S, 50 * S, 50 * S):
        pose.advance(2.0, 0.0, time_ns)
    assert pose.way_m == 0.0
    pose.advance(2.0, 0.0, 5000 * S)
    assert pose.x_m == pytest.approx(1.0)  # half a second's, not 83 minutes'


def test_the_odometry_says_what_it_does_not_know():
    pose = ros2.DeadReckoning()
    pose.advance(1.0, 0.0, 0)
    pose.advance(1.0, 0.0, S // 2)
    unsteered = ros2.odometry_of(feedback(1.0, 0.5), pose, PEDAL.curvature([0.5]))
    assert unsteered.pose.covariance[7] == unsteered.pose.covariance[35] == ros2.UNKNOWN
    assert unsteered.pose.covariance[0] == pytest.approx(0.05**2)
    steered = feedback(1.0, -1.0)
    curvature = STEERING.curvature(steered.action, 0.25)
    assert curvature is not None
    assert curvature > 0  # to the left
    message = ros2.odometry_of(steered, pose, curvature)
    assert message.twist.twist.angular.z == pytest.approx(curvature)
    assert message.pose.covariance[35] == pytest.approx(0.05**2)


class FakeNode:
    def __init__(self):
        self.published = defaultdict(list)

    def publisher(self, topic, _kind):
        topic_key("/x", topic)
        return self.published[topic].append


def heard(topic, payload, at_s=0.0):
    return Heard(f"phil/x/{topic}", topic, payload, round(at_s * S), len(payload))


def outlet_with(status, rate_hz=20.0):
    node: Any = FakeNode()
    return node, ros2.Outlet(node, ros2.Policies(status, clock_s=lambda: 0.0), rate_hz)


def status_of(scenario, *names):
    manifest = {"scenario": scenario, "action": [{"name": name} for name in names]}
    return lambda: {"policy_id": "p", "manifest": manifest}


LEFT_TURN, CONGESTION = status_of("left_turn", "pedal"), status_of("congestion", "steering")


def test_what_cannot_be_read_is_counted_by_topic_and_reason():
    node, outlet = outlet_with(LEFT_TURN)
    for topic in ("state", "command", "feedback", "health", "scene", "alive"):
        outlet.take(heard(topic, b"\xc1"))
    topics = ("state", "command", "feedback")
    assert outlet.rejected == {f"{topic}_malformed": 1 for topic in topics}
    assert not any(node.published.values())


def test_commands_are_shown_once_the_edge_says_whose_they_are(capsys):
    def nobody():
        raise UserError("nobody")

    told = heard("command", encode(command(1.0)))
    node, outlet = outlet_with(LEFT_TURN)
    outlet.take(told)
    (drive,) = node.published["command/ackermann"]
    assert drive.drive.acceleration == 3.0
    _, outlet = outlet_with(nobody)
    outlet.take(told)
    assert outlet.rejected == {"command_unknown_policy": 1}
    _, outlet = outlet_with(status_of("parking"))
    for _ in range(2):
        outlet.take(told)
    assert capsys.readouterr().err.count("'parking' is not known") == 1


@pytest.mark.parametrize(("scenario_mps", "scale"), [(None, 1.0), (4.0, 0.25)])
def test_the_vehicles_scale_is_its_speed_over_the_scenarios(scenario_mps, scale):
    """The Hunter's path is four times as curved as the car's; a stand says nothing of the scale."""
    node, outlet = outlet_with(CONGESTION)
    outlet.take(heard("command", encode(command(0.0))))
    for speed_mps in (1.0, 0.0, 1.0):
        shown_mps = None if scenario_mps is None else scenario_mps * speed_mps
        told = feedback(speed_mps, -1.0, scenario_speed_mps=shown_mps)
        outlet.take(heard("feedback", encode(told), at_s=len(node.published["odom"])))
    car_curvature = STEERING.curvature([-1.0])
    yaw_rates = [message.twist.twist.angular.z for message in node.published["odom"]]
    assert yaw_rates == pytest.approx([car_curvature / scale, 0.0, car_curvature / scale])


def test_a_flood_is_bounded_and_the_pose_still_right():
    node, outlet = outlet_with(LEFT_TURN, rate_hz=10.0)
    for step in range(201):  # 2 s at 100 Hz and 1 m/s
        told = feedback(1.0, 0.0, sent_ns=step * S // 100)
        outlet.take(heard("feedback", encode(told), at_s=step / 100))
    assert 20 <= len(node.published["odom"]) <= 22
    assert outlet.skipped == {"feedback": 201 - len(node.published["odom"])}
    assert node.published["odom"][-1].pose.pose.position.x == pytest.approx(2.0, abs=0.11)
    assert json.dumps(outlet.skipped)


TYPES = {
    "image_raw": "sensor_msgs/msg/Image",
    "odom": "nav_msgs/msg/Odometry",
    "command/ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
    "command/twist": "geometry_msgs/msg/Twist",
}


@contextlib.contextmanager
def ros2_machine(endpoint):
    """Its bridge's place: the tokens that are there, and what was heard, read as a rosbag is."""
    tokens: set[str] = set()
    told: dict[str, list[Any]] = {name: [] for name in TYPES}

    def token(sample):
        (tokens.add if "PUT" in str(sample.kind) else tokens.discard)(str(sample.key_expr))

    def hear(name, sample):
        told[name].append(ros2_side.deserialize(TYPES[name], sample.payload.to_bytes()))

    with contextlib.closing(open_session(connect=endpoint, mode="router")) as session:
        tokens_of = ("@/*/@ros2_lv/**", token)
        declared = [session.liveliness().declare_subscriber(*tokens_of, history=True)]
        for name in TYPES:
            call = functools.partial(hear, name)
            declared.append(session.declare_subscriber(f"hunter01/{name}", call))
        yield tokens, told
        for one in declared:
            one.undeclare()


def start_ros2(endpoint, ros_endpoint, out):
    words = ("--connect", endpoint, "--ros2-listen", ros_endpoint, "--out", str(out))
    return harness.BridgeProcess("ros2", *words)


def test_a_drive_is_shown_to_ros_2_and_ends_with_the_simulator(tmp_path):
    endpoint, ros_endpoint, out = free_endpoint(), free_endpoint(), tmp_path / "ros2.json"
    policy = harness.make_policy(tmp_path, "constant", 0.5)
    with (
        harness.start_simulate(
            endpoint, tmp_path / "r.json", harness.SLOW_TOY, "--episodes", "2"
        ) as run,
        start_ros2(endpoint, ros_endpoint, out) as shown,
        ros2_machine(ros_endpoint) as (tokens, told),
    ):
        assert shown.process.stdout.readline().startswith("ready vehicle_id=hunter01")
        wait_until(lambda: len(tokens) == 5, "the tokens of four topics and the node")
        with harness.start_edge(endpoint, policy, "--vehicle", "mock"):
            assert run.wait() == 0, run.errors
        assert shown.wait(20) == 0, shown.errors
        wait_until(lambda: not tokens, "the tokens to go")
    assert all(told.values())
    for image in told["image_raw"]:
        shape = (image["height"], image["width"], image["step"], image["encoding"])
        assert shape == (45, 80, 80, "mono8")
        # The toy's picture is of one brightness.
        assert len(image["data"]) == 3600 == image["data"].count(image["data"][0])
    drives = [message["drive"] for message in told["command/ackermann"]]
    drives = [drive for drive in drives if drive["acceleration"] == pytest.approx(1.5)]
    assert drives  # half pedal of 3 m/s2; the others are the safe stop before and full brakes
    assert all(0.0 <= drive["speed"] <= 6.0 and drive["steering_angle"] == 0.0 for drive in drives)
    assert any(twist["linear"]["x"] > 0 for twist in told["command/twist"])
    ways = [message["pose"]["pose"]["position"]["x"] for message in told["odom"]]
    assert ways == sorted(ways)
    assert ways[-1] > 0
    report = harness.read(out)
    assert report["sent"]["hunter01/odom"] >= len(ways)
    assert report["dropped"] == 0
    assert "sent: hunter01/image_raw" in shown.output


def test_a_sigterm_ends_it_with_its_counts(tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "counts.json"
    with (
        harness.start_simulate(endpoint, tmp_path / "r.json", harness.SLOW_TOY),
        start_ros2(endpoint, free_endpoint(), out) as shown,
    ):
        shown.process.stdout.readline()
        with contextlib.closing(open_session(connect=endpoint, mode="client")) as stranger:
            sender = stranger.declare_publisher("phil/hunter01/feedback")
            wait_until(lambda: "true" in str(sender.matching_status), "a listener to feedback")
            for _ in range(5):
                sender.put(b"no map")
                time.sleep(0.1)
        shown.process.send_signal(signal.SIGTERM)
        assert shown.wait(20) == 0, shown.errors
    assert harness.read(out)["rejected"]["feedback_malformed"] >= 1


def test_a_sigterm_is_an_interrupt_before_the_session_opens(monkeypatch, refusal):
    handlers = []

    def no_session(*_):
        handlers.append(signal.getsignal(signal.SIGTERM))
        raise UserError("none")

    monkeypatch.setattr("bridge.ros2.open_ros2_session", no_session)
    assert "none" in refusal("ros2")
    assert signal.SIG_DFL not in handlers
