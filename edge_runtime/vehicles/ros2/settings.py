"""What a ROS 2 vehicle's driver takes and gives: the table [ros2] of the runtime's settings."""

from __future__ import annotations

from typing import Optional

import msgspec

from edge_runtime.errors import UserError
from edge_runtime.ros2 import names
from edge_runtime.ros2.endpoint import check_ros2_endpoint

YAW_RATE, STEERING = "yaw_rate", "steering"
_ANGULAR = (YAW_RATE, STEERING)


class Ros2Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`config.example.toml` documents each key. A topic that is empty is not published."""

    listen: Optional[str] = None
    connect: Optional[str] = None
    namespace: str = "/"
    twist_topic: str = "cmd_vel"
    twist_angular: str = YAW_RATE
    ackermann_topic: str = ""
    odometry_topic: str = "odom"
    odometry_angular: str = YAW_RATE


def check_settings(settings: Ros2Settings) -> None:
    """Raise UserError where the settings are not valid, or name nothing to be driven by."""
    if settings.listen is not None and settings.connect is not None:
        raise UserError("[ros2] has both listen and connect: give one of them")
    for endpoint in (settings.listen, settings.connect):
        check_ros2_endpoint(endpoint)
    if not settings.twist_topic and not settings.ackermann_topic:
        raise UserError("[ros2] names no topic to command by: set twist_topic or ackermann_topic")
    topics = [settings.twist_topic, settings.ackermann_topic, settings.odometry_topic]
    keys = [names.key(settings.namespace, topic) for topic in topics if topic]
    if not settings.odometry_topic:
        raise UserError("[ros2] names no odometry_topic: without feedback nothing may drive")
    if len(set(keys)) < len(keys):
        raise UserError(f"[ros2] uses a topic twice: {', '.join(keys)}")
    for key in ("twist_angular", "odometry_angular"):
        value = getattr(settings, key)
        if value not in _ANGULAR:
            raise UserError(
                f"[ros2] {key} {value!r} is not known; choose from {', '.join(_ANGULAR)}"
            )
