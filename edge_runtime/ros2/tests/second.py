"""The other side of the wire, written with a second library: rosbags, with its own definitions.

It knows nothing of messages.py. Messages are dictionaries here, with the names of the .msg files.
"""

from __future__ import annotations

from typing import Any, Dict

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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
