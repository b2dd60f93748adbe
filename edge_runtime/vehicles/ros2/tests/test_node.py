"""Keys and tokens: the forms that zenoh-bridge-ros2dds writes and parses."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from threading import Thread

import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge_runtime.tests.harness import wait_until
from edge_runtime.transport import free_endpoint, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.ros2 import names, node
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.vehicles.ros2.node import Ros2Node
from edge_runtime.vehicles.ros2.tests import second
from edge_runtime.vehicles.ros2.tests.second import KINDS, MESSAGES
from edge_runtime.wire import Reason, Rejection

# As the bridge's own format strings, in a regular expression.
BRIDGE_TOKEN = re.compile(r"@/([^/]+)/@ros2_lv/(MP|MS)/([^/]+)/([^/]+)/([^/]+)")


@pytest.mark.parametrize(
    ("namespace", "topic", "key"),
    [
        ("/", "cmd_vel", "cmd_vel"),
        ("/", "/cmd_vel", "cmd_vel"),
        ("/hunter01", "odom", "hunter01/odom"),
        ("hunter01", "camera/image_raw", "hunter01/camera/image_raw"),
        ("/a/b", "c", "a/b/c"),
        ("/hunter01", "/absolute/odom", "absolute/odom"),
    ],
)
def test_a_key_is_the_name_without_the_first_slash(namespace, topic, key):
    assert names.key(namespace, topic) == key


@pytest.mark.parametrize(
    "name", ["", "1a", "a/1", "a-b", "a//b", "a b", "*", "/**", "é", "a" * 201]
)
def test_what_is_no_ros_name_is_refused_in_one_line(name):
    with pytest.raises(UserError) as caught:
        names.key("/", name)
    assert "\n" not in str(caught.value)


def test_the_root_is_no_topic():
    with pytest.raises(UserError, match="names nothing"):
        names.key("/hunter01", "/")


@pytest.mark.parametrize(
    ("vehicle_id", "namespace"), [("hunter01", "/hunter01"), ("a-b", "/a_b"), ("7up", "/v7up")]
)
def test_every_vehicle_id_gives_a_namespace(vehicle_id, namespace):
    assert names.namespace_of(vehicle_id) == namespace


@given(st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True))
def test_any_vehicle_id_gives_a_valid_namespace(vehicle_id):
    names.check_ros_name(names.namespace_of(vehicle_id))


def test_a_publishers_token_by_the_letter():
    token = names.topic_token(
        "a1b2", names.PUBLISHER, "hunter01/cmd_vel", "geometry_msgs/msg/Twist"
    )
    assert token == (
        "@/a1b2/@ros2_lv/MP/hunter01§cmd_vel/geometry_msgs§msg§Twist/:1:0:0,10:typehash="
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a;"
    )


@pytest.mark.parametrize("type_name", names.TYPES)
@pytest.mark.parametrize("kind", [names.PUBLISHER, names.SUBSCRIBER])
def test_a_token_parses_as_the_bridge_parses_it(type_name, kind):
    token = names.topic_token("a1", kind, "x/y", type_name)
    zenoh.KeyExpr(token)  # raises for what Zenoh would not declare
    found = BRIDGE_TOKEN.fullmatch(token)
    assert found is not None
    zid, role, key, kind_of_message, qos = found.groups()
    assert (zid, role) == ("a1", kind)
    assert key.replace("§", "/") == "x/y"
    assert kind_of_message.replace("§", "/") == type_name
    keyed, reliable, durable, history, user_data = qos.split(":")
    assert (keyed, reliable, durable, history) == ("", str(int(kind == "MP")), "0", "0,10")
    assert re.fullmatch(r"typehash=RIHS01_[0-9a-f]{64};", user_data)


@pytest.mark.parametrize("type_name", names.TYPES)
def test_the_hashes_are_the_second_librarys(type_name):
    assert second.STORE.hash_rihs01(type_name) == f"RIHS01_{names.TYPES[type_name]}"


TWIST = ros.Twist(ros.Vector3(1.5, 0.0, -0.25), ros.Vector3(0.0, 0.0, 0.5))
DRIVE = ros.AckermannDriveStamped(
    ros.Header(ros.Time(7, 9), "abc"), ros.AckermannDrive(0.5, 0.0, 1.25)
)


def type_name(kind):
    return kind.__idl_typename__


def test_a_twist_is_a_header_and_six_doubles():
    assert node.encode(TWIST) == b"\x00\x01\x00\x00" + struct.pack(
        "<6d", 1.5, 0.0, -0.25, 0.0, 0.0, 0.5
    )


def test_a_stamped_drive_aligns_after_its_text():
    # sec, nanosec, 4 bytes with the ending zero, no padding; then five floats.
    by_hand = struct.pack("<iII4s5f", 7, 9, 4, b"abc\0", 0.5, 0.0, 1.25, 0.0, 0.0)
    assert node.encode(DRIVE) == b"\x00\x01\x00\x00" + by_hand
    longer = ros.AckermannDriveStamped(ros.Header(ros.Time(), "abcd"), DRIVE.drive)
    by_hand = struct.pack("<iII8s5f", 0, 0, 5, b"abcd", 0.5, 0.0, 1.25, 0.0, 0.0)
    assert node.encode(longer) == b"\x00\x01\x00\x00" + by_hand


@given(MESSAGES)
def test_the_second_library_reads_what_we_write(message):
    read = second.deserialize(type_name(type(message)), node.encode(message))
    assert read == asdict(message)


@given(MESSAGES)
def test_we_read_what_the_second_library_writes(message):
    name, fields = type_name(type(message)), asdict(message)
    assert node.decode(second.serialize(name, fields), type(message)) == message
    assert node.decode(second.serialize_big_endian(name, fields), type(message)) == message


@given(MESSAGES)
def test_both_write_the_same_bytes(message):
    ours = node.encode(message)
    theirs = second.serialize(type_name(type(message)), asdict(message))
    # rosbags fills the message up to 4 bytes, as a DDS writer does.
    assert theirs.rstrip(b"\0") == ours.rstrip(b"\0")
    assert 0 <= len(theirs) - len(ours) < 4


@settings(max_examples=500)
@given(st.binary(max_size=1200), KINDS)
def test_random_bytes_never_raise(payload, kind):
    assert isinstance(node.decode(payload, kind), (kind, Rejection))


@settings(max_examples=500)
@given(st.sampled_from([b"\0\0\0\0", b"\0\1\0\0"]), st.binary(max_size=1200), KINDS)
def test_random_bytes_after_a_good_header_never_raise(header, body, kind):
    assert isinstance(node.decode(header + body, kind), (kind, Rejection))


@settings(max_examples=300)
@given(MESSAGES, st.data())
def test_a_message_that_is_cut_off_or_damaged_never_raises(message, data):
    payload = bytearray(node.encode(message))
    kind = type(message)
    cut = data.draw(st.integers(0, len(payload) - 1))
    assert isinstance(node.decode(bytes(payload[:cut]), kind), Rejection)
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    assert isinstance(node.decode(bytes(payload), kind), (kind, Rejection))


@pytest.mark.parametrize(
    ("payload", "kind", "reason"),
    [
        (b"", ros.Twist, Reason.MALFORMED),
        (b"\0\1\0", ros.Twist, Reason.MALFORMED),
        (b"\0\7\0\0" + bytes(48), ros.Twist, Reason.SCHEMA),  # XCDR version 2
        (node.encode(TWIST), ros.Odometry, Reason.MALFORMED),
        (node.encode(ros.Odometry()), ros.Twist, Reason.MALFORMED),
        (b"\0\1\0\0" + struct.pack("<6d", *[0.0] * 5, float("nan")), ros.Twist, Reason.NOT_FINITE),
        (b"\0\1\0\0" + struct.pack("<6d", float("inf"), *[0.0] * 5), ros.Twist, Reason.NOT_FINITE),
        (b"\0\1\0\0" + bytes(node.MAX_PAYLOAD_BYTES), ros.Image, Reason.OVERSIZED),
        (b"\0\1\0\0" + struct.pack("<iII", 0, 0, 2**32 - 1), ros.Odometry, Reason.MALFORMED),
        (b"\0\1\0\0" + struct.pack("<iII2s", 0, 0, 3, b"\xff\xff"), ros.Odometry, Reason.MALFORMED),
    ],
)
def test_what_is_no_message_says_why(payload, kind, reason):
    rejection = node.decode(payload, kind)
    assert isinstance(rejection, Rejection)
    assert rejection.reason == reason


def test_a_nan_in_a_covariance_is_not_finite():
    odometry = ros.Odometry()
    odometry.twist.covariance[3] = float("nan")
    assert node.decode(node.encode(odometry), ros.Odometry) == Rejection(
        Reason.NOT_FINITE, "twist.covariance is nan"
    )


def test_an_image_of_the_policy_goes_through_whole():
    pixels = bytes(range(256)) * 14 + bytes(16)
    image = ros.Image(ros.Header(), 45, 80, "mono8", 0, 80, pixels)
    assert second.deserialize(type_name(ros.Image), node.encode(image))["data"] == pixels


def test_a_message_that_dds_has_filled_up_is_read():
    """As Cyclone DDS writes it: up to 4 bytes, and how many were added in the header."""
    image = ros.Image(height=1, width=3, step=3, data=b"abc")
    plain = node.encode(image)
    padding = -len(plain) % 4
    assert padding == 1
    assert node.decode(b"\0\1\0\1" + plain[4:] + b"\0", ros.Image) == image
    too_much = node.decode(plain + bytes(4), ros.Image)
    assert isinstance(too_much, Rejection)


def test_threads_do_not_share_a_buffer():
    """pycdr2's own buffer, one for each type, would mix their bytes."""
    wrong: list[int] = []

    def go(number):
        message = ros.Image(data=bytes([number]) * 3000)
        expected = node.encode(message)
        wrong.extend(1 for _ in range(300) if node.encode(message) != expected)

    threads = [Thread(target=go, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


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
    program = folder / "through_dds"
    idl = ["idlc", "-x", "final", "-l", "c", str(SOURCE / "ros.idl")]
    subprocess.run(idl, cwd=folder, check=True, timeout=60)
    sources = [str(SOURCE / "through_dds.c"), "ros.c"]
    gcc = ["gcc", "-O1", "-I.", "-o", str(program), *sources, "-lddsc"]
    subprocess.run(gcc, cwd=folder, check=True, timeout=60)

    def go(payload, kind):
        (folder / "in").write_bytes(payload)
        done = subprocess.run(
            [str(program), kind.__name__, "in", "out"],
            cwd=folder, env={**os.environ, "CYCLONEDDS_URI": LOOPBACK_ONLY},
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        if done.returncode == REFUSED:
            return None
        assert done.returncode == 0, done.stderr
        return (folder / "out").read_bytes(), done.stdout.strip()

    return go


@needs_cyclone
@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(message=MESSAGES)
def test_dds_takes_any_message_and_gives_it_back(through_dds, message):
    ours, kind = node.encode(message), type(message)
    theirs, type_name = through_dds(ours, kind)
    assert node.decode(theirs, kind) == message
    # Filled up to 4 bytes; how many that are stands in the header's last two bits.
    padding = -len(ours) % 4
    assert theirs == ours[:3] + bytes([padding]) + ours[4:] + bytes(padding)
    package, part, name = kind.__idl_typename__.split("/")
    assert type_name == f"{package}::{part}::dds_::{name}_"


@needs_cyclone
def test_dds_refuses_another_type(through_dds):
    assert through_dds(node.encode(ros.Twist()), ros.Odometry) is None


SLOW_TURN = ros.Twist(ros.Vector3(0.5), ros.Vector3(0.0, 0.0, -0.25))


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
    with closing(Ros2Node(ours, "/hunter01")) as node:
        publish = node.publisher("cmd_vel", ros.Twist)
        wait_until(lambda: len(tokens) == 2, "the tokens of the node and its publisher")
        zid = str(ours.info.zid())
        assert f"@/{zid}/@ros2_lv" in tokens
        assert any(token.startswith(f"@/{zid}/@ros2_lv/MP/hunter01§cmd_vel/") for token in tokens)
        wait_until(lambda: publish(SLOW_TURN) or heard, "the twist")
        read = second.deserialize("geometry_msgs/msg/Twist", heard[0].payload.to_bytes())
        assert read == asdict(SLOW_TURN)
        assert node.sent["hunter01/cmd_vel"] >= 1
    wait_until(lambda: not tokens, "the tokens to go with the node")
    listener.undeclare()
    watcher.undeclare()


def test_a_late_bridge_learns_of_us_too(sessions):
    ours, theirs = sessions
    with closing(Ros2Node(ours, "/")) as node:
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
    with closing(Ros2Node(ours, "/hunter01")) as node:
        node.subscribe("odom", ros.Odometry, heard.append)
        wait_until(lambda: theirs.put("hunter01/odom", good) or heard, "the odometry")
        assert heard[0] == odometry
        theirs.put("hunter01/odom", b"")
        theirs.put("hunter01/odom", b"\0\7\0\0")
        theirs.put("hunter01/odom", bytes(ros.MAX_PAYLOAD_BYTES + 1))
        theirs.put("hunter01/odom", ros.encode(SLOW_TURN))
        wait_until(lambda: sum(node.rejected.values()) >= 4, "the rejections")
        assert node.rejected == {"malformed": 2, "schema": 1, "oversized": 1}


def test_without_pycdr2_one_line_says_what_to_install():
    code = (
        "import sys; sys.modules['pycdr2'] = None\n"
        "from edge_runtime.util import UserError\n"
        "import edge_runtime.vehicles.registry\n"
        "try: import edge_runtime.vehicles.ros2.node\n"
        "except UserError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert "pip install pycdr2" in line
