"""Keys and tokens: the forms that zenoh-bridge-ros2dds writes and parses."""

import importlib
import os
import shutil
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pytest
import zenoh
from hil_tests.processes import wait_until
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.reach import free_endpoint
from edge_runtime.tests import ros2_side as second
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles import ros2
from edge_runtime.vehicles import ros2 as ros
from edge_runtime.vehicles.ros2 import Ros2Node
from edge_runtime.wire import Reason

DOUBLES = st.floats(allow_nan=False, allow_infinity=False)
FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)
# A zero ends a text in CDR, and half a surrogate pair is no text.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
UINT32 = st.integers(0, 2**32 - 1)
HEADERS = st.builds(
    ros.Header, st.builds(ros.RosTime, st.integers(-(2**31), 2**31 - 1), UINT32), TEXTS
)
VECTORS = st.builds(ros.Vector3, *[DOUBLES] * 3)
TWISTS = st.builds(ros.Twist, VECTORS, VECTORS)
POSES = st.builds(ros.RosPose, VECTORS, st.builds(ros.Quaternion, *[DOUBLES] * 4))
COVARIANCES = st.lists(DOUBLES, min_size=36, max_size=36)
ODOMETRIES = st.builds(
    ros.Odometry, HEADERS, TEXTS, st.builds(ros.PoseWithCovariance, POSES, COVARIANCES),
    st.builds(ros.TwistWithCovariance, TWISTS, COVARIANCES),
)  # fmt: skip
DRIVES = st.builds(ros.AckermannDriveStamped, HEADERS, st.builds(ros.AckermannDrive, *[FLOATS] * 5))
MESSAGES = st.one_of(TWISTS, DRIVES, ODOMETRIES)


@pytest.mark.parametrize(
    ("namespace", "topic", "key"),
    [
        ("/", "cmd_vel", "cmd_vel"),
        ("/", "/cmd_vel", "cmd_vel"),
        ("hunter01", "camera/image_raw", "hunter01/camera/image_raw"),
        ("/a/b", "c", "a/b/c"),
        ("/hunter01", "/absolute/odom", "absolute/odom"),
    ],
)
def test_a_key_is_the_name_without_the_first_slash(namespace, topic, key):
    assert ros2.topic_key(namespace, topic) == key


@pytest.mark.parametrize(
    "name", ["", "1a", "a/1", "a-b", "a//b", "a b", "*", "/**", "é", "a" * 201]
)
def test_what_is_no_topic_is_refused_in_one_line(name):
    with pytest.raises(UserError, match=r"^.*is not valid.*$"):  # a dot is no new line
        ros2.topic_key("/hunter01", name)
    with pytest.raises(UserError, match=r"^.*names nothing.*$"):
        ros2.topic_key("/hunter01", "/")


@pytest.mark.parametrize("kind", [ros.Twist, ros.AckermannDriveStamped, ros.Odometry])
@pytest.mark.parametrize(("role", "reliable"), [(ros.PUBLISHER, 1), (ros.SUBSCRIBER, 0)])
def test_tokens_are_the_bridges_with_the_second_librarys_hash(role, reliable, kind):
    name = kind.__idl_typename__
    token = ros.topic_token("a1b2", role, "hunter01/cmd_vel", kind)
    zenoh.KeyExpr(token)  # raises for what Zenoh would not declare
    assert token == (
        f"@/a1b2/@ros2_lv/{role}/hunter01§cmd_vel/{name.replace('/', '§')}"
        f"/:{reliable}:0:0,10:typehash={second.STORE.hash_rihs01(name)};"
    )


@given(MESSAGES)
def test_the_second_library_and_ours_understand_each_other(message):
    kind, name, fields = type(message), message.__idl_typename__, asdict(message)
    ours, theirs = ros.encode(message), second.serialize(name, fields)
    assert second.deserialize(name, ours) == fields
    assert ros.decode(theirs, kind) == message
    assert ros.decode(second.serialize(name, fields, little_endian=False), kind) == message
    # rosbags fills the message up to 4 bytes, as a DDS writer does.
    assert theirs.rstrip(b"\0") == ours.rstrip(b"\0")
    assert 0 <= len(theirs) - len(ours) < 4


@settings(max_examples=200)
@given(
    MESSAGES, st.sampled_from([b"", b"\0\0\0\0", b"\0\1\0\0"]), st.binary(max_size=1200), st.data()
)
def test_random_damaged_and_cut_off_bytes_never_raise(message, header, body, data):
    kind, payload = type(message), bytearray(ros.encode(message))
    assert isinstance(ros.decode(header + body, kind), (kind, Reason))
    cut = data.draw(st.integers(0, len(payload) - 1))
    assert isinstance(ros.decode(bytes(payload[:cut]), kind), Reason)
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    assert isinstance(ros.decode(bytes(payload), kind), (kind, Reason))


UNKNOWN = ros.Odometry()
UNKNOWN.twist.covariance[3] = float("nan")
LE = b"\0\1\0\0"  # how a message of little-endian CDR begins


@pytest.mark.parametrize(
    ("payload", "kind", "reason"),
    [
        (b"", ros.Twist, Reason.MALFORMED),
        (b"\0\1\0", ros.Twist, Reason.MALFORMED),
        (b"\0\7\0\0" + bytes(48), ros.Twist, Reason.SCHEMA),  # XCDR version 2
        (ros.encode(ros.Twist()), ros.Odometry, Reason.MALFORMED),
        (ros.encode(ros.Odometry()), ros.Twist, Reason.MALFORMED),
        (LE + struct.pack("<6d", *[0.0] * 5, float("nan")), ros.Twist, Reason.NOT_FINITE),
        (LE + struct.pack("<6d", float("inf"), *[0.0] * 5), ros.Twist, Reason.NOT_FINITE),
        (LE + bytes(ros.MAX_PAYLOAD_BYTES), ros.Odometry, Reason.OVERSIZED),
        (LE + struct.pack("<iII", 0, 0, 2**32 - 1), ros.Odometry, Reason.MALFORMED),
        (LE + struct.pack("<iII2s", 0, 0, 3, b"\xff\xff"), ros.Odometry, Reason.MALFORMED),
        (ros.encode(ros.Twist()) + bytes(4), ros.Twist, Reason.MALFORMED),
        (ros.encode(UNKNOWN), ros.Odometry, Reason.NOT_FINITE),
    ],
)
def test_what_is_no_message_says_why(payload, kind, reason):
    assert ros.decode(payload, kind) is reason


def test_threads_do_not_share_a_buffer():
    """pycdr2's own buffer, one for each type, would mix their bytes."""

    def named(number):
        return ros.Odometry(child_frame_id=str(number) * 3000)

    def go(number):
        return {ros.encode(named(number)) for _ in range(300)}

    with ThreadPoolExecutor(4) as threads:
        for number, found in enumerate(threads.map(go, range(4))):
            assert found == {ros.encode(named(number))}


SOURCE = Path(__file__).parent / "cyclone"
REFUSED = 3
LOOPBACK_ONLY = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>"
)
needs_cyclone = pytest.mark.skipif(
    shutil.which("idlc") is None or shutil.which("gcc") is None, reason="no Cyclone DDS in C here"
)


@pytest.fixture(scope="module")
def through_dds(tmp_path_factory):
    """Compile; the function returns DDS's own bytes and the type's name, None where it refuses."""
    folder = tmp_path_factory.mktemp("cyclone")
    run = partial(subprocess.run, cwd=folder, timeout=60)
    run(f"idlc -x final -l c {SOURCE}/ros.idl".split(), check=True)
    gcc = f"gcc -O1 -I. -o through_dds {SOURCE}/through_dds.c ros.c -lddsc"
    run(gcc.split(), check=True)

    def go(payload, kind):
        (folder / "in").write_bytes(payload)
        done = run(
            ["./through_dds", kind.__name__, "in", "out"], capture_output=True, text=True,
            env={**os.environ, "CYCLONEDDS_URI": LOOPBACK_ONLY},
        )  # fmt: skip
        if done.returncode == REFUSED:
            return None
        assert done.returncode == 0, done.stderr
        return (folder / "out").read_bytes(), done.stdout.strip()

    return go


@needs_cyclone
@settings(max_examples=20)
@given(message=MESSAGES)
def test_dds_takes_any_message_and_gives_it_back(through_dds, message):
    ours, kind = ros.encode(message), type(message)
    theirs, dds_name = through_dds(ours, kind)
    assert ros.decode(theirs, kind) == message
    # Filled up to 4 bytes; how many that are stands in the header's last two bits.
    padding = -len(ours) % 4
    assert theirs == ours[:3] + bytes([padding]) + ours[4:] + bytes(padding)
    package, part, name = kind.__idl_typename__.split("/")
    assert dds_name == f"{package}::{part}::dds_::{name}_"


@needs_cyclone
def test_dds_refuses_another_type(through_dds):
    assert through_dds(ros.encode(ros.Twist()), ros.Odometry) is None


def test_we_hear_the_second_library_and_count_what_is_none():
    odometry = ros.Odometry(ros.Header(ros.RosTime(5, 6), "odom"), "base_link")
    odometry.twist.twist.linear.x = 0.75
    good = second.serialize("nav_msgs/msg/Odometry", asdict(odometry))
    heard: list = []
    # Theirs is in a bridge's place: a router that connects, as by `-e`.
    endpoint = free_endpoint()
    with open_session(listen=endpoint, mode="router") as ours, open_session(
        connect=endpoint, mode="router"
    ) as theirs, closing(Ros2Node(ours, "/hunter01")) as node:
        node.subscribe("odom", ros.Odometry, heard.append)
        wait_until(lambda: theirs.put("hunter01/odom", good) or heard, "the odometry")
        assert heard[0] == odometry
        huge = bytes(ros.MAX_PAYLOAD_BYTES + 1)
        for payload in (b"", b"\0\7\0\0", huge, ros.encode(ros.Twist())):
            # Zenoh may drop what it cannot send at once.
            theirs.put("hunter01/odom", payload, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: sum(node.rejected.values()) >= 4, "the rejections")
        assert node.rejected == {"malformed": 2, "schema": 1, "oversized": 1}


def test_without_pycdr2_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycdr2", None)
    monkeypatch.delitem(sys.modules, ros.__name__)
    with pytest.raises(UserError, match="pip install pycdr2"):
        importlib.import_module(ros.__name__)
