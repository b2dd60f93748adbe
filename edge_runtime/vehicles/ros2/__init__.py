"""A vehicle behind its own ROS 2 driver: standard messages on Zenoh. See README.md.

First the messages, without ROS 2; then the pure core; then the session and two threads. The stream
thread publishes what `tick` returns, because the ROS driver has no stream of its own; Zenoh's
thread passes every odometry to `hear`.

A message is little-endian CDR (XCDR version 1) behind a header of four bytes, `00 01 00 00`. Each
field is aligned to its size, counted from behind the header. Types and order of fields are those of
common_interfaces (the same from Humble on); units too: metres, seconds, radians, x forward, y,
steering and yaw to the left (REP 103).
"""

from __future__ import annotations

import math
import re
import struct
import time
from typing import Any, ClassVar, Dict, NamedTuple, Optional, Tuple, Type

import zenoh

from edge_runtime import log
from edge_runtime.config import check_choice
from edge_runtime.transport import check_endpoint, is_tls, only_own, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles import streamed
from edge_runtime.vehicles.mapping import RobotSettings, Similarity
from edge_runtime.vehicles.plausibility import Fault, Finding, impossible
from edge_runtime.vehicles.streamed import VehicleEvent, VehicleState

# Not 7447, where our own link and, by default, a bridge listen; and of this machine only.
DEFAULT_ROS2_ENDPOINT = "tcp/127.0.0.1:7448"
YAW_RATE, STEERING = "yaw_rate", "steering"
_WORD = "[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(f"/?{_WORD}(/{_WORD})*")

# Below this the path's curvature, yaw rate over speed, is more noise than steering.
STEERS_FROM_MPS = 0.2


def topic_key(namespace: str, topic: str) -> str:
    """Return a topic's Zenoh key: below the namespace unless it begins with a slash."""
    for name in (topic, *([] if namespace == "/" else [namespace])):
        if not _NAME.fullmatch(name):
            raise UserError(f"ROS name {name!r} is not valid: write it like /hunter01/odom")
    whole = topic if topic.startswith("/") else f"{namespace}/{topic}"
    return whole.strip("/")


class Motion(NamedTuple):
    """What the vehicle is told: `centre_rad` of the front wheels, positive to the left."""

    speed_mps: float
    centre_rad: float


PUBLISHER, SUBSCRIBER = "MP", "MS"
_SLASH = "\u00a7"  # The bridge's replacement for a slash inside one chunk of a token.
TWIST, ODOMETRY = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
# The types' hashes (REP 2016, RIHS01): from Iron on, ROS nodes look for them in discovery.
TYPES: Dict[str, str] = {
    TWIST: "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}

MAX_PAYLOAD_BYTES = 1024 * 1024
_LITTLE_ENDIAN = b"\0\1\0\0"
_ALIGNMENT = 4  # DDS pads a message to this.
# Of an odometry: a position, a quaternion, their covariance; two vectors of speed, theirs.
_DOUBLES = 3 + 4 + 36 + 6 + 36
_LINEAR_X, _ANGULAR_Z = 43, 48


class Odometry(NamedTuple):
    """The fields read of a nav_msgs/Odometry: its stamp (0: none), and its twist (m/s, rad/s)."""

    stamp_ns: int
    linear_x: float
    angular_z: float


def read_odometry(payload: bytes) -> Optional[Odometry]:
    """Return an odometry whose numbers are all finite; None for anything else. Never raises."""
    if payload[:2] != _LITTLE_ENDIAN[:2]:
        return None
    try:
        sec, nanosec, length = struct.unpack_from("<iII", payload, 4)
        child = 16 + _aligned(length, 4)  # behind the name of the frame
        (length,) = struct.unpack_from("<I", payload, child)
        begin = 4 + _aligned(child + length, 8)  # behind the name of the child frame
        numbers = struct.unpack_from(f"<{_DOUBLES}d", payload, begin)
    except struct.error:
        return None
    # The payload does not name its type: left-over bytes mean another type.
    is_longer = len(payload) - begin - 8 * _DOUBLES >= _ALIGNMENT
    if is_longer or not all(map(math.isfinite, numbers)):
        return None
    return Odometry(sec * 10**9 + nanosec, numbers[_LINEAR_X], numbers[_ANGULAR_Z])


def _aligned(place: int, size: int) -> int:
    return -(-place // size) * size


def twist_of(motion: Motion, angular: str, wheelbase_m: float) -> bytes:
    """Return a Twist: `linear.x` in m/s, `angular.z` as yaw rate (rad/s) or steering angle (rad).

    At a stand the yaw rate is 0, whatever the steering: the wheels then go straight.
    """
    z = motion.centre_rad
    if angular != STEERING:
        z = motion.speed_mps * math.tan(motion.centre_rad) / wheelbase_m
    return _LITTLE_ENDIAN + struct.pack("<6d", motion.speed_mps, 0.0, 0.0, 0.0, 0.0, z)


def topic_token(member: str, role: str, key: str, kind: str) -> str:
    """Return the token of a member's PUBLISHER or SUBSCRIBER, as zenoh-bridge-ros2dds has it.

    It makes every bridge (1.1 or later) create the reader or writer on its DDS side. Its last part
    is `<keyed>:<reliable>:<transient local>:<history>,<depth>:<user data>` in DDS's numbers. Our
    writer is reliable, for readers of either kind; our reader is best-effort, as a reliable one
    would not hear the best-effort writers that sensors are.
    """
    names = (name.replace("/", _SLASH) for name in (key, kind))
    qos = f":{int(role == PUBLISHER)}:0:0,10:typehash=RIHS01_{TYPES[kind]};"
    return "/".join((member, role, *names, qos))


class Ros2Settings(RobotSettings, frozen=True, kw_only=True):
    """`config.example.toml` documents each key."""

    listen: Optional[str] = None
    connect: Optional[str] = None
    namespace: str = "/"
    twist_topic: str = "cmd_vel"
    twist_angular: str = YAW_RATE
    odometry_topic: str = "odom"
    odometry_angular: str = YAW_RATE

    def __post_init__(self) -> None:
        for name in ("twist_angular", "odometry_angular"):
            check_choice(f"vehicle.ros2.{name}", getattr(self, name), (YAW_RATE, STEERING))
        if self.listen is not None and self.connect is not None:
            raise UserError("ros2 has both listen and connect: give one of them")
        endpoint = self.listen or self.connect
        if endpoint is not None and is_tls(check_endpoint(endpoint)):
            raise UserError(
                f"endpoint {endpoint} is not for the ROS 2 side: it speaks plain text, as DDS does;"
                " use tcp/ or udp/ on one machine, or inside a tunnel"
            )
        for topic in (self.twist_topic, self.odometry_topic):
            topic_key(self.namespace, topic)


class Ros2Core(streamed.StreamedCore):
    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        super().__init__(similarity, streamed.Speeds())
        self._stamp_ns = 0  # of the newest, by its sender's clock
        self._angular: Optional[float] = None  # of the newest, as the settings say
        self._newest_s = -math.inf
        self._topic = settings.odometry_topic
        self._is_angle = settings.odometry_angular == STEERING

    def enable(self, now_s: float) -> None:
        """Drive again as soon as fresh odometry shows that the vehicle is there."""
        self._stamp_ns = 0  # whatever comes next counts: the sender's clock may have been set back
        self._angular = None
        super().enable(now_s)

    def close(self, now_s: float) -> None:
        self._apply(Finding(VehicleEvent.CLOSE), now_s)

    def hear(self, stamp_ns: int, speed_mps: float, angular: float, now_s: float) -> None:
        """Take finite odometry; ignore it if its stamp is not newer (0: it has no stamp)."""
        # While nothing is driven, an older stamp is accepted (a clock set back), an equal one not.
        is_older = stamp_ns < self._stamp_ns and self._has_asked
        if stamp_ns > 0 and (is_older or stamp_ns == self._stamp_ns):
            return
        self._stamp_ns, self._angular, self._newest_s = stamp_ns, angular, now_s
        self._heard.note(speed_mps, now_s)
        words = impossible(speed_mps, angular if self._is_angle else 0.0, self._spec)
        lie = Finding(Fault.LYING, f"the odometry says {words}") if words else None
        self._apply(lie or Finding(VehicleEvent.CONFIRMED), now_s)

    def tick(self, now_s: float) -> Optional[Motion]:
        self._look(now_s)
        if self.state is VehicleState.DISABLED:
            return None
        self._step(now_s)
        return Motion(self.set_point.speed_mps, self._asked_rad())

    def is_at_rest(self, now_s: float) -> bool:
        """Return whether the vehicle is known to stand, or nothing was ever asked of it."""
        is_fresh = self._silence(-math.inf, now_s) is None
        return self.state is VehicleState.DISABLED or (is_fresh and self._heard.stands)

    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        if now_s - max(self._newest_s, since_s) <= self._heard.silence_s:
            return None
        return Finding(Fault.SILENT, f"no fresh odometry on {self._topic}")

    def _centre_rad(self) -> Optional[float]:
        """Return the odometry's steering angle; None if the speed is too low for a yaw rate's."""
        angular, speed_mps = self._angular, self._heard.speed_mps
        if angular is None or self._is_angle:
            return angular
        if abs(speed_mps) < STEERS_FROM_MPS:
            return None
        return math.atan(self._spec.wheelbase_m * angular / speed_mps)


class Ros2Vehicle(streamed.StreamedVehicle):
    """Opens its session and announces its topics when made; publishes nothing before `enable`."""

    name: ClassVar[str] = "ros2"
    settings_type: ClassVar[Type[RobotSettings]] = Ros2Settings

    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        self._core: Ros2Core
        super().__init__(Ros2Core(settings, similarity))
        self._angular, self._fails = settings.twist_angular, False
        self.steers_at_a_stand = settings.twist_angular == settings.odometry_angular == STEERING
        # A router (by default on loopback), or a peer that goes on connecting to a bridge.
        connect, listen = settings.connect, settings.listen
        if connect is None and listen is None:
            listen = DEFAULT_ROS2_ENDPOINT
        try:
            self._session = open_session(listen, connect, "peer" if connect else "router")
        except UserError as error:
            raise UserError(str(error).replace("--listen", "[vehicle.ros2] listen")) from None
        try:
            self._declared = self._declare(settings)
        except BaseException:
            self._session.close()  # an open session would hang the process at its exit
            raise
        self._stream.start()

    def _declare(self, settings: Ros2Settings) -> Tuple[Any, ...]:
        """Publish, subscribe and announce both; return what must live as long as the session."""
        session, member = self._session, f"@/{self._session.info.zid()}/@ros2_lv"
        twist = topic_key(settings.namespace, settings.twist_topic)
        odometry = topic_key(settings.namespace, settings.odometry_topic)
        # It never waits for a subscriber.
        drop = zenoh.CongestionControl.DROP
        publisher = session.declare_publisher(twist, congestion_control=drop)
        self._publish = publisher.put
        tokens = (
            member,
            topic_token(member, PUBLISHER, twist, TWIST),
            topic_token(member, SUBSCRIBER, odometry, ODOMETRY),
        )
        subscriber = session.declare_subscriber(odometry, only_own(odometry, self._hear))
        return publisher, subscriber, *map(session.liveliness().declare_token, tokens)

    def _leave(self) -> None:
        self._session.close()
        with self._lock:
            self._core.close(time.monotonic())

    def _hear(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_PAYLOAD_BYTES:
            return  # a huge message is not even copied
        odometry = read_odometry(sample.payload.to_bytes())
        if odometry is not None:
            with self._lock:
                self._core.hear(*odometry, time.monotonic())

    def _send_due(self) -> bool:
        with self._lock:
            motion = self._core.tick(time.monotonic())
        if motion is None:
            return False
        try:
            self._publish(twist_of(motion, self._angular, self._core.similarity.spec.wheelbase_m))
            fails = False
        except Exception as error:  # the vehicle stops by its own time-out
            fails = True
            if not self._fails:
                log.event("error", "ros2_not_sent", detail=error)
        self._fails = fails
        return not fails
