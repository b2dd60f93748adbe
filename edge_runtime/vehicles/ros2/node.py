"""ROS 2 on Zenoh without ROS 2: the standard messages that we speak, in CDR, and a node.

Field names, order and types are those of the packages' .msg files (common_interfaces and
ackermann_msgs, the same from Humble on); units as there: metres, seconds, radians, x forward, y to
the left, positive steering and yaw to the left (REP 103). On the wire they are CDR behind a header
of four bytes that says plain CDR (XCDR version 1), little-endian: `00 01 00 00`; a big-endian one
is read, too. Safe with several threads: pycdr2's own buffer, one for each type, is not used.

The one file that imports pycdr2: a board without ROS 2 need not have it. No `from __future__ import
annotations` here: pycdr2 reads the annotations, also on Python 3.8.
"""

import math
import struct
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, List, Type, TypeVar, Union

import zenoh

from edge_runtime.transport import only_own
from edge_runtime.util import UserError
from edge_runtime.vehicles.ros2 import STEERING, Motion, topic_key
from edge_runtime.wire import Reason

try:
    from pycdr2 import IdlStruct

    # Private, but in the signature of `serialize`; the package is pinned, and a test would notice.
    from pycdr2._support import Buffer, Endianness
    from pycdr2.types import array, float32, float64, int32, uint32
except ImportError:
    raise UserError("ROS 2 messages need the package pycdr2: pip install pycdr2") from None


PUBLISHER, SUBSCRIBER = "MP", "MS"
_SLASH = "\u00a7"  # The bridge's replacement for a slash inside one chunk of a token.
TYPES: Dict[str, str] = {
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf"
    ),
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}
"""The types' hashes (REP 2016, RIHS01): from Iron on, ROS nodes look for them in discovery."""

HEADER_BYTES = 4
CDR_BIG_ENDIAN, CDR_LITTLE_ENDIAN = 0, 1
MAX_PAYLOAD_BYTES = 1024 * 1024
_ALIGNMENT = 4  # DDS fills a message up to this.
# What hostile bytes make pycdr2 raise: the end too early, bad UTF-8, absurd lengths.
_DECODE_ERRORS = (struct.error, ValueError, OverflowError, MemoryError, IndexError)
if TYPE_CHECKING:
    Covariance = List[float]
else:
    Covariance = array[float64, 36]


def no_covariance() -> List[float]:
    """A 6x6 matrix of zeros, row by row: to ROS that means unknown."""
    return [0.0] * 36


@dataclass
class Time(IdlStruct, typename="builtin_interfaces/msg/Time"):
    """Seconds and nanoseconds since 1970."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs/msg/Header"):
    """When, and in which coordinate frame."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class AckermannDrive(IdlStruct, typename="ackermann_msgs/msg/AckermannDrive"):
    """`steering_angle` (rad) of a wheel at the centre of the front axle; `speed` in m/s.

    Zero in `acceleration` (m/s2), `jerk` and `steering_angle_velocity` means as quick as can be.
    """

    steering_angle: float32 = 0.0
    steering_angle_velocity: float32 = 0.0
    speed: float32 = 0.0
    acceleration: float32 = 0.0
    jerk: float32 = 0.0


@dataclass
class AckermannDriveStamped(IdlStruct, typename="ackermann_msgs/msg/AckermannDriveStamped"):
    """A drive command and its time."""

    header: Header = field(default_factory=Header)
    drive: AckermannDrive = field(default_factory=AckermannDrive)


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs/msg/Vector3"):
    """Three numbers; as a Point of the same layout, a place in metres."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs/msg/Quaternion"):
    """A rotation; the default is none."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Twist(IdlStruct, typename="geometry_msgs/msg/Twist"):
    """Velocity in m/s and rad/s."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class Pose(IdlStruct, typename="geometry_msgs/msg/Pose"):
    """Where, and turned how."""

    position: Vector3 = field(default_factory=Vector3)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs/msg/PoseWithCovariance"):
    """A pose, and the covariance of x, y, z and the rotations about them."""

    pose: Pose = field(default_factory=Pose)
    covariance: Covariance = field(default_factory=no_covariance)


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs/msg/TwistWithCovariance"):
    """A velocity and its covariance."""

    twist: Twist = field(default_factory=Twist)
    covariance: Covariance = field(default_factory=no_covariance)


@dataclass
class Odometry(IdlStruct, typename="nav_msgs/msg/Odometry"):
    """A pose in the frame `header.frame_id`, and the velocity in the frame `child_frame_id`."""

    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


_M = TypeVar("_M", AckermannDriveStamped, Twist, Odometry)


def encode(message: IdlStruct) -> bytes:
    """The message in little-endian CDR; struct.error for a number that its field cannot hold."""
    return bytes(message.serialize(buffer=Buffer(), endianness=Endianness.Little))


def decode(payload: bytes, kind: Type[_M]) -> Union[_M, Reason]:
    """A message of that kind, all of whose numbers are finite, or why not. Never raises."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return Reason.OVERSIZED
    if len(payload) < HEADER_BYTES:
        return Reason.MALFORMED
    (representation,) = struct.unpack_from(">H", payload)
    if representation not in (CDR_BIG_ENDIAN, CDR_LITTLE_ENDIAN):
        return Reason.SCHEMA
    buffer = Buffer(payload, align_offset=HEADER_BYTES)
    try:
        # A buffer of our own in place of the bytes, to see where the message ends.
        message: _M = kind.deserialize(buffer)  # type: ignore[arg-type]
    except _DECODE_ERRORS:
        return Reason.MALFORMED
    # pycdr2 takes a text or data that is cut off for a short one; and the type is not in the
    # payload: what is left over is the mark of another one.
    if not 0 <= len(payload) - buffer.tell() < _ALIGNMENT:
        return Reason.MALFORMED
    return message if all(map(math.isfinite, _floats(message))) else Reason.NOT_FINITE


def _floats(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, (list, tuple)):  # a covariance
        yield from value
    elif is_dataclass(value):
        for part in vars(value).values():
            yield from _floats(part)


def twist_of(motion: Motion, angular: str, wheelbase_m: float) -> Twist:
    """`linear.x` in m/s; `angular.z` is the yaw rate (rad/s), or the steering angle (rad).

    A yaw rate of 0 says nothing of the wheels of a vehicle that stands: they go straight.
    """
    z = motion.centre_rad
    if angular != STEERING:
        z = motion.speed_mps * math.tan(motion.centre_rad) / wheelbase_m
    return Twist(linear=Vector3(x=motion.speed_mps), angular=Vector3(z=z))


def drive_of(motion: Motion, time_ns: int) -> AckermannDriveStamped:
    """Speed and centre angle; no acceleration is given, because the speed is a ramp already."""
    return AckermannDriveStamped(
        header=Header(Time(*divmod(time_ns, 10**9)), "base_link"),
        drive=AckermannDrive(speed=motion.speed_mps, steering_angle=motion.centre_rad),
    )


def member_token(zid: str) -> str:
    """The token by which a bridge knows another one."""
    return f"@/{zid}/@ros2_lv"


def topic_token(zid: str, role: str, key: str, kind: Any) -> str:
    """The token of a PUBLISHER or SUBSCRIBER of a message, as zenoh-bridge-ros2dds has it.

    It makes every bridge (1.1 or later) create the reader or writer on its DDS side; without it a
    bridge would carry only what a ROS node beside it already wants. Its last part is
    `<keyed>:<reliable>:<transient local>:<history>,<depth>:<user data>` in DDS's numbers. We
    publish reliably, because a reader of either kind matches, and subscribe best effort: a reliable
    reader would never hear a best-effort writer, as sensors are. No key, no old messages for late
    readers, and the last ten kept.
    """
    names = (name.replace("/", _SLASH) for name in (key, kind.__idl_typename__))
    qos = f":{int(role == PUBLISHER)}:0:0,10:typehash=RIHS01_{TYPES[kind.__idl_typename__]};"
    return "/".join((member_token(zid), role, *names, qos))


class Ros2Node:
    """Uses a session that somebody else opens and closes. `close` it before the session.

    `rejected` counts what could not be read, by reason.
    """

    def __init__(self, session: zenoh.Session, namespace: str) -> None:
        self.rejected: Dict[str, int] = {}
        self._session = session
        self._namespace = namespace
        self._zid = str(session.info.zid())
        self._declared: List[Any] = []
        self._announce(member_token(self._zid))

    def publisher(self, topic: str, kind: Type[_M]) -> Callable[[_M], None]:
        """What publishes messages of that kind on that topic. It never waits for a subscriber."""
        key = topic_key(self._namespace, topic)
        publisher = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP
        )
        self._declared.append(publisher)
        self._announce(topic_token(self._zid, PUBLISHER, key, kind))
        return lambda message: publisher.put(encode(message))

    def subscribe(self, topic: str, kind: Type[_M], take: Callable[[_M], None]) -> None:
        """Call `take` with each message, in Zenoh's thread; what cannot be read is counted."""
        key = topic_key(self._namespace, topic)

        def hear(sample: zenoh.Sample) -> None:
            message: Union[_M, Reason] = Reason.OVERSIZED
            if len(sample.payload) <= MAX_PAYLOAD_BYTES:  # something huge is not even copied
                message = decode(sample.payload.to_bytes(), kind)
            if isinstance(message, Reason):
                self.rejected[message.value] = self.rejected.get(message.value, 0) + 1
            else:
                take(message)

        self._declared.append(self._session.declare_subscriber(key, only_own(key, hear)))
        self._announce(topic_token(self._zid, SUBSCRIBER, key, kind))

    def close(self) -> None:
        """Withdraw everything; safe to call twice."""
        while self._declared:
            self._declared.pop().undeclare()

    def _announce(self, token: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(token))
