"""``python -m bridge ros2`` beside a real drive, heard through a second library."""

from __future__ import annotations

import signal
import time
from collections import defaultdict

import pytest

from bridge.tests.processes import (
    SLOW_TOY,
    BridgeProcess,
    bridge_status,
    make_policy,
    read,
    start_edge,
    start_simulate,
)
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import wait_until
from edge_runtime.transport import open_session
from edge_runtime.vehicles.ros2.tests import second


class Listener:
    """A ROS 2 machine's bridge in its place: a session, its tokens, and rosbags to read with."""

    def __init__(self, endpoint):
        self.session = open_session(connect=endpoint, mode="router")
        self.tokens, self.heard = set(), defaultdict(list)
        self.declared = [
            self.session.liveliness().declare_subscriber(
                "@/*/@ros2_lv/**", self._token, history=True
            )
        ]
        for key, type_name in {
            "hunter01/image_raw": "sensor_msgs/msg/Image",
            "hunter01/odom": "nav_msgs/msg/Odometry",
            "hunter01/command/ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
            "hunter01/command/twist": "geometry_msgs/msg/Twist",
        }.items():
            self.declared.append(self.session.declare_subscriber(key, self._reader(key, type_name)))

    def _token(self, sample):
        if "PUT" in str(sample.kind):
            self.tokens.add(str(sample.key_expr))
        else:
            self.tokens.discard(str(sample.key_expr))

    def _reader(self, key, type_name):
        def hear(sample):
            self.heard[key].append(second.deserialize(type_name, sample.payload.to_bytes()))

        return hear

    def __enter__(self):
        return self

    def __exit__(self, *_):
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
        Listener(ros_endpoint) as ros_side,
    ):
        assert shown.process.stdout.readline().startswith("ready vehicle_id=hunter01")
        wait_until(lambda: len(ros_side.tokens) == 5, "the tokens of four topics and the node")
        with start_edge(endpoint, policy, "--vehicle", "mock"):
            assert run.wait() == 0, run.errors
        assert shown.wait(20) == 0, shown.errors
        wait_until(lambda: not ros_side.tokens, "the tokens to go")
    assert len(ros_side.heard) == 4
    for image in ros_side.heard["hunter01/image_raw"]:
        assert (image["height"], image["width"], image["step"]) == (45, 80, 80)
        assert image["encoding"] == "mono8"
        # The toy's picture is of one brightness.
        assert len(image["data"]) == 3600 == image["data"].count(image["data"][0])
    drives = [
        message["drive"]
        for message in ros_side.heard["hunter01/command/ackermann"]
        if message["drive"]["acceleration"] == pytest.approx(1.5)
    ]
    assert drives  # half pedal of 3 m/s2; the others are the safe stop before and full brakes
    assert all(0.0 <= drive["speed"] <= 6.0 and drive["steering_angle"] == 0.0 for drive in drives)
    assert any(twist["linear"]["x"] > 0 for twist in ros_side.heard["hunter01/command/twist"])
    ways = [message["pose"]["pose"]["position"]["x"] for message in ros_side.heard["hunter01/odom"]]
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


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--wait-s", "0"], "nobody answers"),
        (["--vehicle-id", "a/b"], "vehicle id"),
        (["--namespace", "9/x"], "namespace '9/x'"),
        (["--namespace", ""], "empty value after --namespace"),
        (["--ros2-listen", "tls/127.0.0.1:7448"], "plain text"),
        (["--ros2-listen", "nowhere"], "endpoint 'nowhere'"),
        (["--ros2-listen", "tcp/a:1", "--ros2-connect", "tcp/a:1"], "not allowed with"),
        (["--max-rate-hz", "0"], "is not a rate"),
        (["--max-rate-hz", "nan"], "is not a rate"),
        (["--out", "/dev/null/a.json"], "Not a directory"),
        (["--tls", "nowhere"], "plain text despite --tls"),
    ],
)
def test_bad_input_is_one_line_and_status_2(options, part, capsys):
    if not any(option.startswith("--ros2") for option in options):
        options = [*options, "--ros2-listen", free_endpoint()]
    assert bridge_status(["ros2", "--connect", free_endpoint(), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line


def test_a_busy_ros_2_port_names_the_option_to_change(capsys):
    busy = free_endpoint()
    session = open_session(listen=busy, mode="router")
    assert bridge_status(["ros2", "--connect", free_endpoint(), "--ros2-listen", busy]) == 2
    session.close()
    (line,) = capsys.readouterr().err.splitlines()
    assert "is in use" in line
    assert "--ros2-listen" in line
