"""The other side of the wire, written with a second library: rosbags, with its own definitions.

It knows nothing of messages.py. Messages are dictionaries here, with the names of the .msg files.
"""

from __future__ import annotations

from typing import Any, Dict

import numpy as np
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edge_runtime.vehicles.ros2 import node as ros

# Not part of common_interfaces: the definition as ros-drivers/ackermann_msgs has it.
_ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\n"
        "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    ),
}

STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in _ACKERMANN.items():
    STORE.register(get_types_from_msg(_text, _name))


def serialize(type_name: str, message: Dict[str, Any]) -> bytes:
    """CDR of a message given as a dictionary."""
    return bytes(STORE.serialize_cdr(_build(type_name, message), type_name, little_endian=True))


def serialize_big_endian(type_name: str, message: Dict[str, Any]) -> bytes:
    """The same in the other byte order."""
    return bytes(STORE.serialize_cdr(_build(type_name, message), type_name, little_endian=False))


def deserialize(type_name: str, payload: bytes) -> Dict[str, Any]:
    """The message as a dictionary, arrays as lists and sequences of bytes as bytes."""
    return _plain(STORE.deserialize_cdr(payload, type_name))


def _build(type_name: str, message: Dict[str, Any]) -> Any:
    _, fields = STORE.fielddefs[type_name]
    values = {}
    for name, (_, kind) in fields:
        value = message[name]
        if isinstance(value, dict):
            value = _build(str(kind), value)
        elif isinstance(value, bytes):
            value = np.frombuffer(value, dtype=np.uint8)
        elif isinstance(value, list):
            value = np.array(value, dtype=np.float64)
        values[name] = value
    return STORE.types[type_name](**values)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("__")]
        return {name: _plain(getattr(value, name)) for name in names}
    return value


DOUBLES = st.floats(allow_nan=False, allow_infinity=False)
FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)
# A zero ends a text in CDR, and half a surrogate pair is no text.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
UINT32 = st.integers(0, 2**32 - 1)

TIMES = st.builds(ros.Time, st.integers(-(2**31), 2**31 - 1), UINT32)
HEADERS = st.builds(ros.Header, TIMES, TEXTS)
VECTORS = st.builds(ros.Vector3, DOUBLES, DOUBLES, DOUBLES)
TWISTS = st.builds(ros.Twist, VECTORS, VECTORS)
QUATERNIONS = st.builds(ros.Quaternion, DOUBLES, DOUBLES, DOUBLES, DOUBLES)
COVARIANCES = st.lists(DOUBLES, min_size=36, max_size=36)
ODOMETRIES = st.builds(
    ros.Odometry,
    HEADERS,
    TEXTS,
    st.builds(ros.PoseWithCovariance, st.builds(ros.Pose, VECTORS, QUATERNIONS), COVARIANCES),
    st.builds(ros.TwistWithCovariance, TWISTS, COVARIANCES),
)
DRIVES = st.builds(ros.AckermannDrive, FLOATS, FLOATS, FLOATS, FLOATS, FLOATS)
STAMPED_DRIVES = st.builds(ros.AckermannDriveStamped, HEADERS, DRIVES)
IMAGES = st.builds(
    ros.Image,
    HEADERS,
    UINT32,
    UINT32,
    TEXTS,
    st.integers(0, 255),
    UINT32,
    st.binary(max_size=100),
)
MESSAGES = st.one_of(TWISTS, STAMPED_DRIVES, ODOMETRIES, IMAGES)
KINDS = st.sampled_from([ros.Twist, ros.AckermannDriveStamped, ros.Odometry, ros.Image])
