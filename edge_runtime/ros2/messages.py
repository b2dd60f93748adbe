"""The standard ROS 2 messages that we speak, field by field, for pycdr2.

Field names, order and types are those of the packages' .msg files (common_interfaces and
ackermann_msgs, the same from Humble on); units as there: metres, seconds, radians, x forward, y to
the left, positive steering and yaw to the left (REP 103). Only cdr.py and those who fill a message
in need this module, and with it pycdr2.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, List

from edge_runtime.ros2.library import (
    IdlStruct,
    array,
    float32,
    float64,
    int32,
    uint8,
    uint32,
)

COVARIANCE_SIZE = 36
if TYPE_CHECKING:
    Covariance = List[float]
else:
    Covariance = array[float64, COVARIANCE_SIZE]


def no_covariance() -> List[float]:
    """A 6x6 matrix of zeros, row by row: to ROS that means unknown."""
    return [0.0] * COVARIANCE_SIZE


# No `from __future__ import annotations` here: pycdr2 reads the annotations, also on Python 3.8.
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


@dataclass
class Image(IdlStruct, typename="sensor_msgs/msg/Image"):
    """`height` rows of `step` bytes each."""

    header: Header = field(default_factory=Header)
    height: uint32 = 0
    width: uint32 = 0
    encoding: str = "mono8"
    is_bigendian: uint8 = 0
    step: uint32 = 0
    data: bytes = b""  # On the wire a sequence of uint8; pycdr2 copies bytes in one piece.


def stamp_of(time_ns: int) -> Time:
    """The wall clock's nanoseconds as a ROS time."""
    return Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
