"""The driver of a ROS 2 vehicle: a thread and a Zenoh session around core.py.

- The stream's thread publishes what `tick` gives: the vehicle's ROS driver makes a frame of each
  message, and has no stream of its own.
- Zenoh's thread hands every odometry to `hear`.
"""

from __future__ import annotations

import math
import time
from typing import Callable, ClassVar, Dict, List

from edge_runtime import log
from edge_runtime.config import Ros2Settings
from edge_runtime.vehicles.mapping import Similarity
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.vehicles.ros2.core import Measured, Motion, Ros2Core
from edge_runtime.vehicles.ros2.names import STEERING, check_settings, open_ros2_session
from edge_runtime.vehicles.ros2.node import Ros2Node
from edge_runtime.vehicles.stream import StreamedVehicle

BASE_FRAME = "base_link"


def twist_of(motion: Motion, angular: str, wheelbase_m: float) -> ros.Twist:
    """`linear.x` in m/s; `angular.z` is the yaw rate (rad/s), or the steering angle (rad).

    A yaw rate of 0 says nothing of the wheels of a vehicle that stands: they go straight.
    """
    z = motion.centre_rad
    if angular != STEERING:
        z = motion.speed_mps * math.tan(motion.centre_rad) / wheelbase_m
    return ros.Twist(linear=ros.Vector3(x=motion.speed_mps), angular=ros.Vector3(z=z))


def drive_of(motion: Motion, time_ns: int) -> ros.AckermannDriveStamped:
    """Speed and centre angle; no acceleration is given, because the speed is a ramp already."""
    return ros.AckermannDriveStamped(
        header=ros.Header(ros.stamp_of(time_ns), BASE_FRAME),
        drive=ros.AckermannDrive(speed=motion.speed_mps, steering_angle=motion.centre_rad),
    )


def measured_of(odometry: ros.Odometry) -> Measured:
    """The velocity along the vehicle, and the rotation, of an odometry."""
    stamp, twist = odometry.header.stamp, odometry.twist.twist
    return Measured(
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
        speed_mps=twist.linear.x,
        angular=twist.angular.z,
    )


class Ros2Vehicle(StreamedVehicle):
    """Opens its session and announces its topics when made; publishes nothing before `enable`.

    Raises UserError, when made, for settings that are not valid and for a busy port.
    """

    name: ClassVar[str] = "ros2"

    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        check_settings(settings)
        self._settings, self._spec = settings, similarity.spec
        self._core: Ros2Core
        super().__init__(Ros2Core(settings, similarity))
        self._failing = False
        self._publish: List[Callable[[Motion], None]] = []
        self._session = open_ros2_session(settings.listen, settings.connect, "[ros2] listen")
        try:
            self._node = Ros2Node(self._session, settings.namespace)
            self._declare()
        except BaseException:
            self._session.close()  # An open session would hang the process at its exit.
            raise

    @property
    def rejected(self) -> Dict[str, int]:
        """Odometry that could not be read or was not new, by reason."""
        counts = dict(self._node.rejected)
        if self._core.odometry.stale:
            counts["stale"] = self._core.odometry.stale
        return counts

    def close(self) -> None:
        """Publish speed 0 until it stands, and leave."""
        if self._closed:
            return
        self._closed = True
        self._end_stream()
        try:
            if self.rejected:
                log.event("info", "ros2_odometry_rejected", **self.rejected)
            self._log_gaps()
            self._node.close()
        finally:
            with self._lock:
                self._core.close(time.monotonic())
            self._session.close()

    def _declare(self) -> None:
        settings, node = self._settings, self._node
        if settings.twist_topic:
            twist = node.publisher(settings.twist_topic, ros.Twist)
            angular, wheelbase_m = settings.twist_angular, self._spec.wheelbase_m
            self._publish.append(lambda motion: twist(twist_of(motion, angular, wheelbase_m)))
        if settings.ackermann_topic:
            drive = node.publisher(settings.ackermann_topic, ros.AckermannDriveStamped)
            self._publish.append(lambda motion: drive(drive_of(motion, time.time_ns())))

        def hear(odometry: ros.Odometry) -> None:
            with self._lock:
                self._core.hear(measured_of(odometry), time.monotonic())

        node.subscribe(settings.odometry_topic, ros.Odometry, hear)

    def _send_due(self) -> bool:
        with self._lock:
            motion = self._core.tick(time.monotonic())
        if motion is None:
            return False
        try:
            for publish in self._publish:
                publish(motion)
        except Exception as error:  # the vehicle stops by its own time-out, and the silence tells
            if not self._failing:
                log.event("error", "ros2_not_sent", detail=error)
            self._failing = True
            return False
        self._failing = False
        return True
