"""Nodes on real Zenoh sessions; the other side speaks through the second library only."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict

import pytest

from edge_runtime.ros2 import cdr
from edge_runtime.ros2 import messages as ros
from edge_runtime.ros2.node import open_node
from edge_runtime.ros2.tests import second
from edge_runtime.tests.harness import wait_until
from edge_runtime.transport import free_endpoint, open_session

TWIST = ros.Twist(ros.Vector3(0.5), ros.Vector3(0.0, 0.0, -0.25))


@pytest.fixture
def sessions():
    """Ours that listens, and a bridge's in its place: a router that connects, as by `-e`."""
    endpoint = free_endpoint()
    ours = open_session(listen=endpoint, mode="router")
    theirs = open_session(connect=endpoint, mode="router")
    yield ours, theirs
    theirs.close()
    ours.close()


def watch_tokens(session):
    """What a bridge watches: the tokens that are there now, by key."""
    here: set[str] = set()

    def change(sample):
        change_set = here.add if "PUT" in str(sample.kind) else here.discard
        change_set(str(sample.key_expr))

    subscriber = session.liveliness().declare_subscriber("@/*/@ros2_lv/**", change, history=True)
    return here, subscriber


def test_what_we_publish_arrives_and_is_announced(sessions):
    ours, theirs = sessions
    heard = []
    listener = theirs.declare_subscriber("hunter01/cmd_vel", lambda s: heard.append(s))
    tokens, watcher = watch_tokens(theirs)
    with open_node(ours, "/hunter01") as node:
        publish = node.publisher("cmd_vel", ros.Twist)
        wait_until(lambda: len(tokens) == 2, "the tokens of the node and its publisher")
        zid = str(ours.info.zid())
        assert f"@/{zid}/@ros2_lv" in tokens
        assert any(token.startswith(f"@/{zid}/@ros2_lv/MP/hunter01§cmd_vel/") for token in tokens)
        wait_until(lambda: publish(TWIST) or heard, "the twist")
        read = second.deserialize("geometry_msgs/msg/Twist", heard[0].payload.to_bytes())
        assert read == asdict(TWIST)
        assert node.sent["hunter01/cmd_vel"] >= 1
    wait_until(lambda: not tokens, "the tokens to go with the node")
    listener.undeclare()
    watcher.undeclare()


def test_a_late_bridge_learns_of_us_too(sessions):
    ours, theirs = sessions
    with open_node(ours, "/") as node:
        node.subscribe("odom", ros.Odometry, lambda _: None)
        tokens, watcher = watch_tokens(theirs)
        wait_until(lambda: any("/MS/odom/" in token for token in tokens), "the earlier token")
        watcher.undeclare()


def test_we_hear_the_second_library_and_count_what_is_none(sessions):
    ours, theirs = sessions
    heard: list[ros.Odometry] = []
    odometry = ros.Odometry(ros.Header(ros.Time(5, 6), "odom"), "base_link")
    odometry.twist.twist.linear.x = 0.75
    good = second.serialize("nav_msgs/msg/Odometry", asdict(odometry))
    with open_node(ours, "/hunter01") as node:
        node.subscribe("odom", ros.Odometry, heard.append)
        wait_until(lambda: theirs.put("hunter01/odom", good) or heard, "the odometry")
        assert heard[0] == odometry
        theirs.put("hunter01/odom", b"")
        theirs.put("hunter01/odom", b"\0\7\0\0")
        theirs.put("hunter01/odom", bytes(cdr.MAX_PAYLOAD_BYTES + 1))
        theirs.put("hunter01/odom", cdr.encode(TWIST))
        wait_until(lambda: sum(node.rejected.values()) >= 4, "the rejections")
        assert node.rejected == {"malformed": 2, "schema": 1, "oversized": 1}


def test_without_pycdr2_one_line_says_what_to_install():
    code = (
        "import sys; sys.modules['pycdr2'] = None\n"
        "from edge_runtime.errors import UserError\n"
        "import edge_runtime.vehicles.registry\n"
        "try: import edge_runtime.ros2.cdr\n"
        "except UserError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert "pip install pycdr2" in line
