"""ROS 2: messages against a second library (rosbags), the core in made-up time, real sessions."""

import contextlib
import importlib
import math
import struct
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import numpy as np
import pytest
import zenoh
from hil_tests.processes import wait_until
from hil_tests.testing.edge import Simulator, run_edge
from hil_tests.testing.vehicles import CONGESTION, LEFT_TURN, PEDAL, STREAM_S, Ros2Rig
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles import ros2
from edge_runtime.vehicles.core import VehicleState
from edge_runtime.vehicles.plausibility import Fault
from edge_runtime.vehicles.ros2 import (
    STEERING,
    YAW_RATE,
    AckermannDriveStamped,
    Motion,
    Odometry,
    Ros2Core,
    Ros2Settings,
    Ros2Vehicle,
    Twist,
    drive_of,
    twist_of,
)
from edge_runtime.wire import Reason

DOUBLES = st.floats(allow_nan=False, allow_infinity=False)
FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)
# A zero ends a text in CDR, and half a surrogate pair is no text.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
STAMPS = st.builds(ros2.RosTime, st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
HEADERS = st.builds(ros2.Header, STAMPS, TEXTS)
VECTORS = st.builds(ros2.Vector3, *[DOUBLES] * 3)
TWISTS = st.builds(Twist, VECTORS, VECTORS)
POSES = st.builds(ros2.RosPose, VECTORS, st.builds(ros2.Quaternion, *[DOUBLES] * 4))
COVARIANCES = st.lists(DOUBLES, min_size=36, max_size=36)
ODOMETRIES = st.builds(
    Odometry, HEADERS, TEXTS, st.builds(ros2.PoseWithCovariance, POSES, COVARIANCES),
    st.builds(ros2.TwistWithCovariance, TWISTS, COVARIANCES),
)  # fmt: skip
DRIVES = st.builds(AckermannDriveStamped, HEADERS, st.builds(ros2.AckermannDrive, *[FLOATS] * 5))
MESSAGES = st.one_of(TWISTS, DRIVES, ODOMETRIES)

STORE = get_typestore(Stores.ROS2_HUMBLE)
# Not part of common_interfaces: the definition as ros-drivers/ackermann_msgs has it.
for _name, _text in (
    ("AckermannDrive", "float32 steering_angle\nfloat32 steering_angle_velocity\n"
     "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"),
    ("AckermannDriveStamped", "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"),
):  # fmt: skip
    STORE.register(get_types_from_msg(_text, f"ackermann_msgs/msg/{_name}"))


def serialize(message, little_endian=True):
    """The second library's CDR of one of our messages."""

    def build(name, values):
        fields = {
            field: build(str(kind), values[field])
            if isinstance(values[field], dict)
            else np.array(values[field]) if isinstance(values[field], list) else values[field]
            for field, (_, kind) in STORE.fielddefs[name][1]
        }  # fmt: skip
        return STORE.types[name](**fields)

    name = type(message).__idl_typename__
    built = build(name, asdict(message))
    return bytes(STORE.serialize_cdr(built, name, little_endian=little_endian))


def plain(value):
    """Its message as a dictionary, arrays as lists."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("__")]
        return {name: plain(getattr(value, name)) for name in names}
    return value


@pytest.mark.parametrize(
    ("namespace", "topic", "key"),
    [
        ("/", "/cmd_vel", "cmd_vel"),
        ("hunter01", "camera/image_raw", "hunter01/camera/image_raw"),
        ("/hunter01", "/absolute/odom", "absolute/odom"),
        *(("/", name, None) for name in ("", "1a", "a//b", "a b", "*", "é", "/", "a" * 201)),
    ],
)
def test_a_key_is_the_name_without_the_first_slash(namespace, topic, key):
    with contextlib.nullcontext() if key else pytest.raises(UserError):
        assert ros2.topic_key(namespace, topic) == key


@pytest.mark.parametrize("kind", [Twist, AckermannDriveStamped, Odometry])
@pytest.mark.parametrize(("role", "reliable"), [(ros2.PUBLISHER, 1), (ros2.SUBSCRIBER, 0)])
def test_tokens_are_the_bridges_with_the_second_librarys_hash(role, reliable, kind):
    name = kind.__idl_typename__
    token = ros2.topic_token("a1b2", role, "hunter01/cmd_vel", kind)
    zenoh.KeyExpr(token)  # raises for what Zenoh would not declare
    assert token == (
        f"@/a1b2/@ros2_lv/{role}/hunter01§cmd_vel/{name.replace('/', '§')}"
        f"/:{reliable}:0:0,10:typehash={STORE.hash_rihs01(name)};"
    )


@given(MESSAGES)
def test_the_second_library_and_ours_understand_each_other(message):
    kind = type(message)
    ours, theirs = ros2.encode(message), serialize(message)
    assert plain(STORE.deserialize_cdr(ours, kind.__idl_typename__)) == asdict(message)
    assert ros2.decode(theirs, kind) == message
    assert ros2.decode(serialize(message, little_endian=False), kind) == message
    # rosbags fills the message up to 4 bytes, as a DDS writer does.
    assert theirs.rstrip(b"\0") == ours.rstrip(b"\0")
    assert 0 <= len(theirs) - len(ours) < 4


@settings(max_examples=200)
@given(
    MESSAGES, st.sampled_from([b"", b"\0\0\0\0", b"\0\1\0\0"]), st.binary(max_size=1200), st.data()
)
def test_random_damaged_and_cut_off_bytes_never_raise(message, header, body, data):
    kind, payload = type(message), bytearray(ros2.encode(message))
    assert isinstance(ros2.decode(header + body, kind), (kind, Reason))
    cut = data.draw(st.integers(0, len(payload) - 1))
    assert isinstance(ros2.decode(bytes(payload[:cut]), kind), Reason)
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    assert isinstance(ros2.decode(bytes(payload), kind), (kind, Reason))


UNKNOWN = Odometry()
UNKNOWN.twist.covariance[3] = float("nan")
LE = b"\0\1\0\0"  # how a message of little-endian CDR begins


@pytest.mark.parametrize(
    ("payload", "kind", "reason"),
    [
        (b"\0\1\0", Twist, Reason.MALFORMED),
        (b"\0\7\0\0" + bytes(48), Twist, Reason.SCHEMA),  # XCDR version 2
        (ros2.encode(Twist()), Odometry, Reason.MALFORMED),
        (ros2.encode(Odometry()), Twist, Reason.MALFORMED),
        (LE + struct.pack("<6d", *[0.0] * 5, math.nan), Twist, Reason.NOT_FINITE),
        (LE + bytes(ros2.MAX_PAYLOAD_BYTES), Odometry, Reason.OVERSIZED),
        (LE + struct.pack("<iII", 0, 0, 2**32 - 1), Odometry, Reason.MALFORMED),
        (LE + struct.pack("<iII2s", 0, 0, 3, b"\xff\xff"), Odometry, Reason.MALFORMED),
        (ros2.encode(Twist()) + bytes(4), Twist, Reason.MALFORMED),
        (ros2.encode(UNKNOWN), Odometry, Reason.NOT_FINITE),
    ],
)
def test_what_is_no_message_says_why(payload, kind, reason):
    assert ros2.decode(payload, kind) is reason


def test_threads_do_not_share_a_buffer():
    """pycdr2's own buffer, one for each type, would mix their bytes."""

    def go(number):
        odometry = Odometry(child_frame_id=str(number) * 3000)
        return {ros2.encode(odometry) for _ in range(300)}

    with ThreadPoolExecutor(4) as threads:
        assert [len(found) for found in threads.map(go, range(4))] == [1] * 4


def test_without_pycdr2_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycdr2", None)
    monkeypatch.delitem(sys.modules, ros2.__name__)
    with pytest.raises(UserError, match="pip install pycdr2"):
        importlib.import_module(ros2.__name__)


# The core, in made-up time; more in test_streamed_core.py.


def test_only_odometry_confirms_it_and_without_any_it_stops_and_says_so():
    rig = Ros2Rig()
    rig.talks = False
    rig.core.enable(rig.now_s)
    rig.step(55, PEDAL)
    assert {motion for _, motion in rig.sent} == {Motion(0.0, 0.0)}
    assert rig.core.state is VehicleState.STOPPED
    assert rig.words == ["no odometry on odom within 1 s", "no fresh odometry on odom"]
    assert rig.report.standing == ["no fresh odometry on odom"]


def test_odometry_that_repeats_its_stamp_is_silence():
    rig = Ros2Rig().driving()
    rig.talks = False
    for _ in range(15):
        rig.core.hear(round(100 * 1e9), 0.5, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert (rig.core.cause, rig.words[0]) == (Fault.SILENT, "no fresh odometry on odom")


def test_a_clock_set_back_is_believed_once_nothing_is_driven_and_after_the_next_enable():
    rig = Ros2Rig().driving()
    rig.talks = False
    rig.core.hear(5, 0.0, 0.0, rig.now_s)
    assert rig.core.stale == 1
    for tick in range(6, 45):
        rig.core.hear(tick, 0.0, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert rig.core.cause is Fault.SILENT
    assert rig.core.standing(rig.now_s) == []  # else no re-arm would ever be taken
    rig.core.enable(rig.now_s)
    rig.core.hear(3, 0.0, 0.0, rig.now_s)
    assert rig.core.state is VehicleState.ENABLED


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
    rig.angular = 0.749  # 1.3 times full lock, as of the inner wheel: some drivers report that one
    rig.step(2)
    assert (rig.core.cause is Fault.LYING) == (angular == STEERING)
    rig = Ros2Rig("congestion").enabled()
    rig.obeys = False  # at a stand a yaw rate tells nothing: the asked steering is reported
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


class RosHunter:
    """The ROS machine: a bridge's session, and behind it a Hunter that follows a Twist at 50 Hz."""

    def __init__(self, listen=None, connect=None, namespace=""):
        self.twists: list = []
        self.drives: list = []
        self.tokens: set = set()  # what a bridge watches
        self.speed_mps, self.silent = 0.0, False
        self._session = session = open_session(listen=listen, connect=connect, mode="router")
        prefix = f"{namespace}/" if namespace else ""
        self.put = session.declare_publisher(f"{prefix}odom").put
        self._declared = [
            session.declare_subscriber(f"{prefix}{topic}", self._taker(kind, heard))
            for topic, kind, heard in (
                ("cmd_vel", Twist, self.twists),
                ("ackermann_cmd", AckermannDriveStamped, self.drives),
            )
        ]
        self._watch = session.liveliness().declare_subscriber(
            "@/*/@ros2_lv/**", self._note_token, history=True
        )
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()
        self._session.close()

    @property
    def asked_mps(self):
        return self.twists[-1].linear.x if self.twists else 0.0

    @staticmethod
    def _taker(kind, heard):
        name = kind.__idl_typename__
        return lambda sample: heard.append(STORE.deserialize_cdr(sample.payload.to_bytes(), name))

    def _note_token(self, sample):
        change = self.tokens.add if "PUT" in str(sample.kind) else self.tokens.discard
        change(str(sample.key_expr))

    def _run(self):
        while not self._stopping.wait(0.02):
            self.speed_mps += 0.3 * (self.asked_mps - self.speed_mps)
            odometry = Odometry(ros2.Header(ros2.RosTime(*divmod(time.time_ns(), 10**9)), "odom"))
            twist = odometry.twist.twist
            twist.linear.x = self.speed_mps
            if self.asked_mps:
                twist.angular.z = self.speed_mps * self.twists[-1].angular.z / self.asked_mps
            if not self.silent:
                self.put(serialize(odometry))


def test_both_kinds_of_command_below_a_namespace_their_tokens_and_what_is_no_odometry(monkeypatch):
    """At a bridge that listens; in the last test it connects."""
    endpoint = free_endpoint()
    topics = {"namespace": "/robot", "ackermann_topic": "ackermann_cmd"}
    monkeypatch.setattr(Ros2Vehicle, "control_period_s", 0.1)
    with RosHunter(listen=endpoint, namespace="robot") as hunter, contextlib.closing(
        Ros2Vehicle(Ros2Settings(connect=endpoint, **topics), CONGESTION)
    ) as vehicle:

        def turns():
            # Or while this machine paused.
            if vehicle.state in (VehicleState.DISABLED, VehicleState.STOPPED):
                vehicle.enable(time.monotonic())
            vehicle.command({"steering": -1.0}, time.monotonic(), scenario_speed_mps=4.0)
            at_speed = hunter.drives and hunter.drives[-1].drive.speed > 0.99
            report = vehicle.feedback(time.monotonic())
            return at_speed and report.action["steering"] == pytest.approx(-1.0, abs=0.01)

        wait_until(turns, "the turn")
        assert hunter.drives[-1].drive.steering_angle > 0  # -1 turns left
        chunks = sorted("/".join(token.split("/")[3:5]) for token in hunter.tokens)
        assert chunks == ["", "MP/robot§ackermann_cmd", "MP/robot§cmd_vel", "MS/robot§odom"]
        bad, rejected = (
            (b"", b"\0\7\0\0", bytes(ros2.MAX_PAYLOAD_BYTES + 1)),
            vehicle._node.rejected,
        )
        wait_until(lambda: any(map(hunter.put, bad)) or len(rejected) == 3, "the rejections")
        for _ in range(2):
            vehicle.close()  # Zeros go out until it stands.
        wait_until(lambda: not hunter.tokens, "the tokens to go")
        assert hunter.speed_mps < 0.1
        assert [twist.linear.x for twist in hunter.twists[-5:]] == [0.0] * 5
        vehicle.enable(time.monotonic())
        assert vehicle.state is VehicleState.DISABLED


def test_it_drives_and_stops_when_the_odometry_falls_silent(make_policy, tmp_path):
    endpoint, ros_endpoint, toml = free_endpoint(), free_endpoint(), tmp_path / "edge.toml"
    toml.write_text(f"vehicle.driver = 'ros2'\n[vehicle.ros2]\nlisten = '{ros_endpoint}'")
    flags = [*make_policy(value=1.0).flags, "--connect", endpoint, "--config", str(toml)]
    with Simulator(endpoint) as simulator, run_edge(*flags) as edge, RosHunter(
        connect=ros_endpoint
    ) as hunter:
        simulator.wait_for_edge()
        wait_until(lambda: len(hunter.twists) > 10, "zeros")
        assert hunter.asked_mps == 0.0
        with pytest.raises(UserError, match=r"another with \[vehicle.ros2\] listen$"):
            Ros2Vehicle(Ros2Settings(listen=ros_endpoint), LEFT_TURN)
        # Nobody may have been there for the first enabling.
        simulator.drive_until(lambda: hunter.speed_mps > 0.5, "the Hunter to drive", rearms=True)
        wait_until(lambda: simulator.feedback[-1].speed_mps > 0.3, "its feedback")
        assert simulator.feedback[-1].vehicle == "ros2"
        hunter.silent = True
        silence = "no fresh odometry on odom"
        simulator.drive_until(lambda: silence in simulator.feedback[-1].faults, "the fault")
        assert hunter.asked_mps == 0.0
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0
