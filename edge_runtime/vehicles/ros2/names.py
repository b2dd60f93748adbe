"""What a ROS 2 vehicle is called: topics, keys and liveliness tokens, and where a bridge is met.

Keys and tokens are as zenoh-bridge-ros2dds 1.1 and later has them. A topic `/hunter01/odom` has the
key `hunter01/odom`. A token on `@/<zid>/@ros2_lv/MP/<key>/<type>/<qos>` (MS for a subscriber) makes
every bridge create the reader or writer on its DDS side; without it a bridge would carry only what
a ROS node beside it already wants. README.md says what else of the bridge's convention we keep, and
what not. No pycdr2 here: settings are checked where it is not installed, too.
"""

from __future__ import annotations

import re
from typing import Dict, Optional

import zenoh

from edge_runtime.config import Ros2Settings, check_choice
from edge_runtime.transport import check_endpoint, is_tls, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import SPECS

PUBLISHER, SUBSCRIBER = "MP", "MS"
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MAX_CHARS = 200
_SLASH = "\u00a7"  # The bridge's replacement for a slash inside one chunk of a token.
# Beside our own 7447, where a bridge listens by default, too; and of this machine only.
DEFAULT_ROS2_ENDPOINT = "tcp/127.0.0.1:7448"
YAW_RATE, STEERING = "yaw_rate", "steering"
_ANGULAR = (YAW_RATE, STEERING)


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


def topic_token(zid: str, role: str, topic_key: str, type_name: str) -> str:
    """The token of a PUBLISHER or SUBSCRIBER of a type in TYPES.

    Its last part is `<keyed>:<reliable>:<transient local>:<history>,<depth>:<user data>` in DDS's
    numbers. We publish reliably, because a reader of either kind matches, and subscribe best
    effort: a reliable reader would never hear a best-effort writer, as sensors are. No key, no
    old messages for late readers, and the last ten kept.
    """
    names = (name.replace("/", _SLASH) for name in (topic_key, type_name))
    qos = f":{int(role == PUBLISHER)}:0:0,10:typehash=RIHS01_{TYPES[type_name]};"
    return "/".join((member_token(zid), role, *names, qos))


def check_ros2_endpoint(endpoint: Optional[str]) -> None:
    """Raise UserError for an endpoint (None is one that was not given) that cannot be used."""
    if endpoint is not None and is_tls(check_endpoint(endpoint)):
        raise UserError(
            f"endpoint {endpoint} is not for the ROS 2 side: it speaks plain text, as DDS does;"
            " use tcp/ or udp/ on one machine, or inside a tunnel"
        )


def open_ros2_session(
    listen: Optional[str], connect: Optional[str], option: str = "--ros2-listen"
) -> zenoh.Session:
    """Listen as a router (the default, on loopback), or go on connecting to a bridge as a peer.

    Raises UserError for a malformed endpoint and for a busy port; `option` is where the user has
    set `listen`.
    """
    check_ros2_endpoint(listen)
    check_ros2_endpoint(connect)
    if connect is not None:
        return open_session(connect=connect, mode="peer")
    try:
        return open_session(listen=listen or DEFAULT_ROS2_ENDPOINT, mode="router")
    except UserError as error:
        raise UserError(str(error).replace("--listen", option)) from None


def check_settings(settings: Ros2Settings) -> None:
    """Raise UserError where the settings are not valid, or name nothing to be driven by."""
    check_choice("ros2.model", settings.model, tuple(SPECS))
    check_choice("ros2.twist_angular", settings.twist_angular, _ANGULAR)
    check_choice("ros2.odometry_angular", settings.odometry_angular, _ANGULAR)
    if settings.listen is not None and settings.connect is not None:
        raise UserError("ros2 has both listen and connect: give one of them")
    for endpoint in (settings.listen, settings.connect):
        check_ros2_endpoint(endpoint)
    if not settings.twist_topic and not settings.ackermann_topic:
        raise UserError("ros2 has no topic to command by: set twist_topic or ackermann_topic")
    if not settings.odometry_topic:
        raise UserError("ros2 has no odometry_topic: without feedback nothing may drive")
    topics = [settings.twist_topic, settings.ackermann_topic, settings.odometry_topic]
    keys = [key(settings.namespace, topic) for topic in topics if topic]
    if len(set(keys)) < len(keys):
        raise UserError(f"ros2 uses a topic twice: {', '.join(keys)}")
