"""From our wire to the topics of a ROS 2 node: what is read, translated, bounded and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from bridge.feed import Heard
from bridge.to_ros2.dead_reckoning import DeadReckoning
from bridge.to_ros2.policies import Policies
from bridge.to_ros2.rates import RateBound
from bridge.to_ros2.translate import (
    drive_of,
    feedback_curvature,
    image_of,
    odometry_of,
    twist_of,
)
from edge_runtime import wire
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.vehicles.ros2.node import Ros2Node
from edge_runtime.wire import Command, Feedback, Rejection, State

# Not cmd_vel and not ackermann_cmd: this shows what is commanded, and must move nothing.
IMAGE, ODOMETRY = "image_raw", "odom"
DRIVE, TWIST = "command/ackermann", "command/twist"


class Outlet:
    """Publishes what it is given; used by one thread.

    `rejected` counts what our wire brought and could not be read or shown, by topic and reason.
    """

    def __init__(self, node: Ros2Node, policies: Policies, max_rate_hz: float) -> None:
        self.rejected: Counter[str] = Counter()
        self._policies = policies
        self._bounds = {topic: RateBound(max_rate_hz) for topic in ("state", "command", "feedback")}
        self._image = node.publisher(IMAGE, ros.Image)
        self._odometry = node.publisher(ODOMETRY, ros.Odometry)
        self._drive = node.publisher(DRIVE, ros.AckermannDriveStamped)
        self._twist = node.publisher(TWIST, ros.Twist)
        self._pose = DeadReckoning()
        self._speed_mps, self._scale = 0.0, 1.0

    @property
    def skipped(self) -> dict[str, int]:
        """Return how many messages of each topic came faster than the bound."""
        return {topic: bound.skipped for topic, bound in self._bounds.items() if bound.skipped}

    def take(self, heard: Heard) -> None:
        """Show one message; topics that ROS 2 has no standard message for are left out."""
        row = _ROWS.get(heard.topic)
        if row is None:
            return
        decode, show = row
        message = decode(heard.payload)
        if isinstance(message, Rejection):
            self.rejected[f"{heard.topic}_{message.reason.value}"] += 1
        else:
            show(self, message, self._bounds[heard.topic].lets(heard.arrived_ns * 1e-9))

    def show_state(self, state: State, may_publish: bool) -> None:
        """Publish the newest frame; the speed is kept, whatever the rate."""
        self._speed_mps = state.speed_mps
        if may_publish:
            self._image(image_of(state))

    def show_command(self, command: Command, may_publish: bool) -> None:
        """Publish the command in both forms, once its policy is known."""
        if not may_publish:
            return
        policy = self._policies.find(command.policy_id)
        if policy is None:
            self.rejected["command_unknown_policy"] += 1
            return
        drive = drive_of(command, self._speed_mps, policy)
        self._drive(drive)
        self._twist(twist_of(drive.drive, policy.car))

    def show_feedback(self, feedback: Feedback, may_publish: bool) -> None:
        """Go on with the dead reckoning at every message, and publish it at the bounded rate."""
        self._scale = _scale_of(feedback, self._scale)
        policy = self._policies.newest
        curvature = policy and feedback_curvature(feedback, policy, self._scale)
        self._pose.advance(feedback.speed_mps, curvature or 0.0, feedback.sent_ns)
        if may_publish:
            self._odometry(odometry_of(feedback, self._pose, curvature))


def _scale_of(feedback: Feedback, last: float) -> float:
    """Metres of the vehicle for one of the scenario, where it moves and reports both speeds."""
    if not feedback.scenario_speed_mps or not feedback.speed_mps:
        return last
    return abs(feedback.speed_mps / feedback.scenario_speed_mps)


_ROWS: dict[str, tuple[Callable[[bytes], Any], Callable[[Outlet, Any, bool], None]]] = {
    "state": (wire.decode_state, Outlet.show_state),
    "command": (wire.decode_command, Outlet.show_command),
    "feedback": (wire.decode_feedback, Outlet.show_feedback),
}
