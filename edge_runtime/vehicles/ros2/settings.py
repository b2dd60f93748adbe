"""What a ROS 2 vehicle's driver takes and gives: the table [ros2] of the runtime's settings."""

from __future__ import annotations

from typing import Optional, Sequence

import msgspec

from edge_runtime.errors import UserError
from edge_runtime.ros2 import names
from edge_runtime.ros2.endpoint import check_ros2_endpoint
from edge_runtime.vehicles.hunter.specs import SPECS

YAW_RATE, STEERING = "yaw_rate", "steering"
_ANGULAR = (YAW_RATE, STEERING)


class Ros2Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`config.example.toml` documents each key. A topic that is empty is not published."""

    model: str = "2.0"
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
    _check_choice("model", settings.model, tuple(SPECS))
    _check_choice("twist_angular", settings.twist_angular, _ANGULAR)
    _check_choice("odometry_angular", settings.odometry_angular, _ANGULAR)
    if settings.listen is not None and settings.connect is not None:
        raise UserError("ros2 has both listen and connect: give one of them")
    for endpoint in (settings.listen, settings.connect):
        check_ros2_endpoint(endpoint)
    _check_topics(settings)


def _check_topics(settings: Ros2Settings) -> None:
    if not settings.twist_topic and not settings.ackermann_topic:
        raise UserError("ros2 has no topic to command by: set twist_topic or ackermann_topic")
    if not settings.odometry_topic:
        raise UserError("ros2 has no odometry_topic: without feedback nothing may drive")
    topics = [settings.twist_topic, settings.ackermann_topic, settings.odometry_topic]
    keys = [names.key(settings.namespace, topic) for topic in topics if topic]
    if len(set(keys)) < len(keys):
        raise UserError(f"ros2 uses a topic twice: {', '.join(keys)}")


def _check_choice(key: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise UserError(f"ros2.{key} {value!r} is not known; choose from {', '.join(known)}")
