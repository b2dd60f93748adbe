"""ROS 2: messages against a second library (rosbags), the core in made-up time, real sessions."""

import contextlib
import math
import struct
import threading
import time
from typing import Any

import numpy as np
import pytest
import zenoh
from hil_tests.processes import wait_until
from hil_tests.tests.shared.drives import Simulator, run_edge
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from edge_runtime.reach import free_endpoint
from edge_runtime.tests.rigs import CONGESTION, LEFT_TURN, PEDAL, Ros2Rig
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles import ros2
from edge_runtime.vehicles.mapping import SPECS
from edge_runtime.vehicles.plausibility import Fault
from edge_runtime.vehicles.ros2 import (
    ODOMETRY,
    STEERING,
    TWIST,
    YAW_RATE,
    Motion,
    Odometry,
    Ros2Settings,
    Ros2Vehicle,
    read_odometry,
    twist_of,
)
from edge_runtime.vehicles.streamed import VehicleState

STORE: Any = get_typestore(Stores.ROS2_HUMBLE)


def odometry(stamp_ns, numbers, frames=("odom", "base_link")):
    """The second library's bytes of an Odometry of 85 numbers."""
    numbers = np.array(numbers, dtype=np.float64)

    def make(kind, *fields):
        return STORE.types[kind.replace("/", "/msg/")](*fields)

    stamp = make("builtin_interfaces/Time", *divmod(stamp_ns, 10**9))
    pose = make(
        "geometry_msgs/Pose", make("geometry_msgs/Point", *numbers[:3]),
        make("geometry_msgs/Quaternion", *numbers[3:7]),
    )  # fmt: skip
    vectors = [make("geometry_msgs/Vector3", *numbers[at : at + 3]) for at in (43, 46)]
    message = make(
        "nav_msgs/Odometry", make("std_msgs/Header", stamp, frames[0]), frames[1],
        make("geometry_msgs/PoseWithCovariance", pose, numbers[7:43]),
        make("geometry_msgs/TwistWithCovariance", make("geometry_msgs/Twist", *vectors),
             numbers[49:]),
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, ODOMETRY))


def twisted(stamp_ns, linear_x, angular_z):
    numbers = [0.0] * 85
    numbers[43], numbers[48] = linear_x, angular_z
    return odometry(stamp_ns, numbers)


@pytest.mark.parametrize(
    ("namespace", "topic", "key"),
    [
        ("/", "/cmd_vel", "cmd_vel"),
        ("hunter01", "camera/image_raw", "hunter01/camera/image_raw"),
        ("/hunter01", "/absolute/odom", "absolute/odom"),
        *(("/", name, None) for name in ("", "1a", "a//b", "a b", "*", "é", "/", "a\n")),
    ],
)
def test_a_key_is_the_name_without_the_first_slash(namespace, topic, key):
    with contextlib.nullcontext() if key else pytest.raises(UserError):
        assert ros2.topic_key(namespace, topic) == key


@pytest.mark.parametrize("kind", [TWIST, ODOMETRY])
@pytest.mark.parametrize(("role", "reliable"), [(ros2.PUBLISHER, 1), (ros2.SUBSCRIBER, 0)])
def test_tokens_are_the_bridges_with_the_second_librarys_hash(role, reliable, kind):
    token = ros2.topic_token("@/a1b2/@ros2_lv", role, "hunter01/cmd_vel", kind)
    zenoh.KeyExpr(token)  # raises for what Zenoh would not declare
    assert token == (
        f"@/a1b2/@ros2_lv/{role}/hunter01§cmd_vel/{kind.replace('/', '§')}"
        f"/:{reliable}:0:0,10:typehash={STORE.hash_rihs01(kind)};"
    )


DOUBLES = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=85, max_size=85)
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
STAMPS = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9)


@given(STAMPS, DOUBLES, st.tuples(TEXTS, TEXTS), st.data())
def test_the_second_librarys_odometry_is_read_and_damaged_or_cut_off_never_raises(
    stamp_ns, numbers, frames, data
):
    payload = bytearray(odometry(stamp_ns, numbers, frames))
    assert read_odometry(bytes(payload)) == Odometry(stamp_ns, numbers[43], numbers[48])
    cut = data.draw(st.integers(0, len(payload) - 1))
    assert read_odometry(bytes(payload[:cut])) is None
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    read_odometry(bytes(payload))


LE = b"\0\1\0\0"  # how a message of little-endian CDR begins


@pytest.mark.parametrize(
    "payload",
    [
        b"\0\1\0",
        b"\0\7\0\0" + bytes(720),  # XCDR version 2
        LE + struct.pack("<iII", 0, 0, 2**32 - 1),
        twist_of(Motion(1.0, 0.0), YAW_RATE, 0.65),
        twisted(1, 0.0, 0.0) + bytes(4),
        twisted(1, math.nan, 0.0),
        odometry(1, [0.0] * 84 + [math.inf]),
    ],
)
def test_what_is_no_odometry_is_not_read(payload):
    assert read_odometry(payload) is None


def hunter_ros2_inner_rad(linear_x, angular_z, spec):
    """The inner wheel's angle that the maker's driver sends to the chassis for a Twist."""
    if angular_z == 0.0:
        return 0.0
    side, radius_m = math.copysign(1.0, angular_z), abs(linear_x) / abs(angular_z)
    if radius_m < spec.wheelbase_m:
        return side * spec.max_inner_steering_rad
    inner_rad = math.atan(spec.wheelbase_m / (radius_m - spec.track_m / 2))
    return side * (-inner_rad if linear_x < 0.0 else inner_rad)


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(speed_mps=st.floats(-1.0, 1.0), share=st.floats(-1.0, 1.0))
def test_the_makers_driver_turns_the_wheels_as_they_are_asked_to_backwards_too(
    spec, speed_mps, share
):
    inner_rad = share * spec.max_inner_steering_rad
    motion = Motion(speed_mps, spec.centre_rad(inner_rad))
    twist = STORE.deserialize_cdr(twist_of(motion, YAW_RATE, spec.wheelbase_m), TWIST)
    if abs(twist.angular.z) < 1e-300:  # it stands, or next to: a yaw rate of 0 tells no angle
        return
    found_rad = hunter_ros2_inner_rad(twist.linear.x, twist.angular.z, spec)
    assert found_rad == pytest.approx(inner_rad, abs=1e-9)


def test_commands_by_hand_in_the_second_librarys_bytes():
    """1 m/s on a circle of 2 m: 0.5 rad/s, and an angle of atan(0.65 / 2) as hunter_ros2 has it."""
    motion = Motion(1.0, math.atan(0.65 / 2.0))
    for angular, z in ((YAW_RATE, 0.5), (STEERING, motion.centre_rad)):
        ours = twist_of(motion, angular, 0.65)
        twist = STORE.deserialize_cdr(ours, TWIST)
        assert bytes(STORE.serialize_cdr(twist, TWIST)) == ours
        assert (twist.linear.x, twist.angular.z) == pytest.approx((1.0, z))


# The core, in made-up time; more in test_streamed.py.


def test_only_odometry_confirms_it_and_without_any_it_stops_and_says_so():
    rig, silence = Ros2Rig(), "no fresh odometry on odom"
    rig.talks = False
    rig.core.enable(rig.now_s)
    rig.step(55, PEDAL)
    assert {motion for _, motion in rig.sent} == {Motion(0.0, 0.0)}
    assert rig.words == [f"not enabled within 1 s: {silence}", silence]
    assert rig.report.standing == [silence]


@pytest.mark.parametrize(("stamp_ns", "cause"), [(round(100 * 1e9), Fault.SILENT), (0, None)])
def test_odometry_that_repeats_its_stamp_is_silence_and_without_stamps_it_is_believed(
    stamp_ns, cause
):
    rig = Ros2Rig().driving()
    rig.talks = False
    for _ in range(15):
        rig.core.hear(stamp_ns, rig.speed_mps, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert rig.core.cause is cause


def test_a_clock_set_back_is_believed_once_nothing_is_driven_and_after_the_next_enable():
    rig = Ros2Rig().driving()
    rig.talks = False
    for tick in range(5, 45):
        rig.core.hear(tick, 0.0, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert rig.core.cause is Fault.SILENT
    assert rig.core.standing(rig.now_s) == []  # else no re-arm would ever be taken
    rig.core.enable(rig.now_s)
    rig.core.hear(3, 0.0, 0.0, rig.now_s)
    assert rig.core.state is VehicleState.ENABLED


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


def test_at_a_stand_a_yaw_rate_tells_nothing_and_the_asked_steering_is_reported():
    rig = Ros2Rig("congestion").enabled()
    rig.obeys = False
    rig.step(25, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert rig.report.action["steering"] == pytest.approx(0.5, abs=1e-6)


class RosHunter:
    """The ROS machine: a bridge's session, and behind it a Hunter that follows a Twist at 50 Hz."""

    def __init__(self, listen=None, connect=None, prefix=""):
        self.twists: list = []
        self.tokens: set = set()  # what a bridge watches
        self.speed_mps, self.silent = 0.0, False
        self._session = session = open_session(listen=listen, connect=connect, mode="router")
        self.put = session.declare_publisher(f"{prefix}odom").put
        self._declared = (
            session.declare_subscriber(f"{prefix}cmd_vel", self._take),
            session.liveliness().declare_subscriber(
                "@/*/@ros2_lv/**", self._note_token, history=True
            ),
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

    def _take(self, sample):
        self.twists.append(STORE.deserialize_cdr(sample.payload.to_bytes(), TWIST))

    def _note_token(self, sample):
        change = self.tokens.add if "PUT" in str(sample.kind) else self.tokens.discard
        change(str(sample.key_expr))

    def _run(self):
        while not self._stopping.wait(0.02):
            self.speed_mps += 0.3 * (self.asked_mps - self.speed_mps)
            yaw_radps = 0.0
            if self.asked_mps:
                yaw_radps = self.speed_mps * self.twists[-1].angular.z / self.asked_mps
            if not self.silent:
                self.put(twisted(time.time_ns(), self.speed_mps, yaw_radps))


def test_a_turn_below_a_namespace_its_tokens_and_what_is_no_odometry(monkeypatch):
    """At a bridge that listens; in the next test it connects."""
    endpoint = free_endpoint()
    settings = Ros2Settings(connect=endpoint, namespace="/robot")
    monkeypatch.setattr(Ros2Vehicle, "control_period_s", 0.1)
    with RosHunter(listen=endpoint, prefix="robot/") as hunter, contextlib.closing(
        Ros2Vehicle(settings, CONGESTION)
    ) as vehicle:

        def turns():
            # Or while this machine paused.
            if vehicle._core.state in (VehicleState.DISABLED, VehicleState.STOPPED):
                vehicle.enable(time.monotonic())
            vehicle.command({"steering": -1.0}, time.monotonic(), scenario_speed_mps=4.0)
            for bad in (b"", LE + bytes(ros2.MAX_PAYLOAD_BYTES)):
                hunter.put(bad)
            report = vehicle.feedback(time.monotonic())
            is_turned = report.action["steering"] == pytest.approx(-1.0, abs=0.01)
            return hunter.asked_mps > 0.99 and is_turned

        wait_until(turns, "the turn")
        assert hunter.twists[-1].angular.z > 0  # -1 turns left
        chunks = sorted("/".join(token.split("/")[3:5]) for token in hunter.tokens)
        assert chunks == ["", "MP/robot§cmd_vel", "MS/robot§odom"]
        for _ in range(2):
            vehicle.close()  # Zeros go out until it stands.
        wait_until(lambda: not hunter.tokens, "the tokens to go")
        assert [twist.linear.x for twist in hunter.twists[-5:]] == [0.0] * 5
        vehicle.enable(time.monotonic())
        assert vehicle._core.state is VehicleState.DISABLED


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
        hunter.silent = True
        silence = "no fresh odometry on odom"
        simulator.drive_until(lambda: silence in simulator.feedback[-1].faults, "the fault")
        assert hunter.asked_mps == 0.0
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0
