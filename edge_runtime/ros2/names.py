"""Keys and liveliness tokens as zenoh-bridge-ros2dds 1.1 and later has them. Pure.

A topic `/hunter01/odom` has the key `hunter01/odom`. A token on
`@/<zid>/@ros2_lv/MP/<key>/<type>/<qos>` (MS for a subscriber) makes every bridge create the
reader or writer on its DDS side; without it a bridge would carry only what a ROS node beside it
already wants. README.md says what else of the bridge's convention we keep, and what not.
"""

from __future__ import annotations

import re
from typing import Dict, NamedTuple

from edge_runtime.errors import UserError

PUBLISHER, SUBSCRIBER = "MP", "MS"
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MAX_CHARS = 200
_SLASH = "\u00a7"  # The bridge's replacement for a slash inside one chunk of a token.


class Qos(NamedTuple):
    """What of a DDS quality of service stands in a token, with DDS's numbers."""

    reliable: bool
    transient_local: bool = False
    depth: int = 10


RELIABLE = Qos(reliable=True)
"""For our publishers: a reader of either kind matches."""
BEST_EFFORT = Qos(reliable=False)
"""For our subscribers: a reliable reader would never hear a best-effort writer, as of sensors."""

TYPES: Dict[str, str] = {
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf"
    ),
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
}
"""The types' hashes (REP 2016, RIHS01): from Iron on, ROS nodes look for them in discovery."""


def check_ros_name(name: str, what: str = "ROS name") -> str:
    """The name itself, as in `/hunter01/odom` or `/`; UserError if ROS would not take it."""
    plain = name[1:] if name.startswith("/") else name
    parts = plain.split("/") if plain else []
    valid = len(name) <= _MAX_CHARS and all(_TOKEN.fullmatch(part) for part in parts)
    if not name or not valid:
        raise UserError(
            f"{what} {name!r} is not valid: words of A-Z a-z 0-9 _ that begin with no digit,"
            f" between slashes, {_MAX_CHARS} characters at most, like /hunter01/odom"
        )
    return name


def key(namespace: str, topic: str) -> str:
    """The Zenoh key of a topic: below the namespace, or as it is where it begins with a slash."""
    check_ros_name(namespace, "namespace")
    check_ros_name(topic, "topic")
    whole = topic if topic.startswith("/") else f"{namespace}/{topic}"
    joined = "/".join(part for part in whole.split("/") if part)
    if not joined:
        raise UserError(f"topic {topic!r} names nothing")
    return joined


def namespace_of(vehicle_id: str) -> str:
    """A ROS namespace for a vehicle id, which may hold a hyphen and begin with a digit."""
    word = vehicle_id.replace("-", "_")
    return f"/v{word}" if word[:1].isdigit() else f"/{word}"


def member_token(zid: str) -> str:
    """The token by which a bridge knows another one."""
    return f"@/{zid}/@ros2_lv"


def topic_token(zid: str, kind: str, topic_key: str, type_name: str, qos: Qos) -> str:
    """The token of a PUBLISHER or SUBSCRIBER of a type in TYPES."""
    chunks = (kind, topic_key.replace("/", _SLASH), type_name.replace("/", _SLASH))
    return "/".join((member_token(zid), *chunks, _qos_chunk(qos, TYPES[type_name])))


def _qos_chunk(qos: Qos, type_hash: str) -> str:
    """`<keyed>:<reliability>:<durability>:<history>,<depth>:<user data>`; ours have no key."""
    history = f"0,{qos.depth}"  # Keep last.
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:{history}:typehash=RIHS01_{type_hash};"
