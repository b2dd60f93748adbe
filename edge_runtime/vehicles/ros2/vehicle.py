"""The driver of a vehicle behind ROS 2: first what decides, then the session and thread around it.

Ros2Core is pure: odometry in, motion out. Around it are two threads:
- The stream's thread publishes what `tick` gives: the vehicle's ROS driver makes a frame of each
  message, and has no stream of its own.
- Zenoh's thread hands every odometry to `hear`.
"""

from __future__ import annotations

import math
import time
from typing import Callable, ClassVar, Dict, List, NamedTuple, Optional

from edge_runtime import log
from edge_runtime.config import Ros2Settings
from edge_runtime.vehicles.core import (
    ENABLE_TIMEOUT_S,
    IMPOSSIBLE,
    LEADS_TO,
    Event,
    Finding,
    Speeds,
    State,
    StreamedCore,
)
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.vehicles.ros2.names import STEERING, check_settings, open_ros2_session
from edge_runtime.vehicles.stream import StreamedVehicle
from edge_runtime.wire import CONTROL_PERIOD_S

BASE_FRAME = "base_link"
ODOMETRY_SILENCE_S = 2 * CONTROL_PERIOD_S
# Below this the path's curvature, yaw rate over speed, is more noise than steering.
STEERS_FROM_MPS = 0.2

# Odometry that cannot be confirms nothing, and need not be waited for.
ROS2_LEADS_TO = {
    **LEADS_TO,
    Event.LYING: {State.ENABLING: State.STOPPED, State.ENABLED: State.STOPPED},
}


class Measured(NamedTuple):
    """One odometry message: `stamp_ns` by its sender's clock, `angular` as the settings say."""

    stamp_ns: int
    speed_mps: float
    angular: float


class OdometryReports(Speeds):
    """The newest odometry, and the speeds of the last control period."""

    def __init__(self, settings: Ros2Settings, spec: HunterSpec) -> None:
        super().__init__()
        self.heard_s = -math.inf
        self.stale = 0  # repetitions and late ones: they show nobody alive
        self._newest: Optional[Measured] = None
        self._spec = spec
        self._is_angle = settings.odometry_angular == STEERING

    def begin(self) -> None:
        """Take whatever comes next: a clock on the other side may have been set back."""
        self._newest = None
        self.forget()

    def hear(self, measured: Measured, now_s: float) -> bool:
        """Note a message; False for one that is not newer than the last by its own stamp.

        A sender that leaves its stamps at 0 is believed by the time of arrival alone.
        """
        newest = self._newest
        if newest is not None and 0 < measured.stamp_ns <= newest.stamp_ns:
            self.stale += 1
            return False
        self._newest, self.heard_s = measured, now_s
        self.note(measured.speed_mps, now_s)
        return True

    @property
    def is_impossible(self) -> bool:
        """Whether it says a speed that the vehicle cannot have."""
        return abs(self.speed_mps) > IMPOSSIBLE * self._spec.max_speed_mps

    def centre_rad(self) -> Optional[float]:
        """The front wheels' centre angle; None where a yaw rate cannot tell it: it hardly moves."""
        if self._newest is None:
            return None
        if self._is_angle:
            return self._newest.angular
        if abs(self.speed_mps) < STEERS_FROM_MPS:
            return None
        return math.atan(self._spec.wheelbase_m * self._newest.angular / self.speed_mps)


class Motion(NamedTuple):
    """What the vehicle is told: `centre_rad` of the front wheels, positive to the left."""

    speed_mps: float
    centre_rad: float


class Ros2Core(StreamedCore):
    """The state machine, what was heard, and what is asked for."""

    leads_to = ROS2_LEADS_TO

    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        self.odometry = OdometryReports(settings, similarity.spec)
        super().__init__(similarity, self.odometry)
        self._topic = settings.odometry_topic

    def enable(self, now_s: float) -> None:
        """Drive again as soon as fresh odometry shows that somebody is there."""
        self.odometry.begin()
        super().enable(now_s)

    def close(self, now_s: float) -> None:
        """Nothing more is sent."""
        self._apply(Finding(Event.CLOSE, ""), now_s)

    def hear(self, measured: Measured, now_s: float) -> None:
        """An odometry message whose numbers are finite."""
        if not self.odometry.hear(measured, now_s):
            return
        if self.odometry.is_impossible:
            words = f"the odometry says {measured.speed_mps:.2f} m/s"
            self._apply(Finding(Event.LYING, words), now_s)
        else:
            self._apply(Finding(Event.CONFIRMED, ""), now_s)

    def tick(self, now_s: float) -> Optional[Motion]:
        """What to publish now; None while DISABLED."""
        self._watch(now_s)
        if self.state is State.DISABLED:
            return None
        self._step(now_s)
        set_point = self.set_point
        return Motion(set_point.speed_mps, self._spec.centre_rad(set_point.inner_rad))

    def is_at_rest(self, now_s: float) -> bool:
        """Whether the vehicle is known to stand, or nothing was ever asked of it."""
        is_fresh = not self._silence(-math.inf, now_s)
        return self.state is State.DISABLED or (is_fresh and self.odometry.stands)

    def _obstacles(self, now_s: float) -> List[str]:
        silence = self._silence(-math.inf, now_s)
        return [silence] if silence else []

    def _why_not_confirmed(self, now_s: float) -> str:
        return f"no odometry on {self._topic} within {ENABLE_TIMEOUT_S:.0f} s"

    def _wrong(self, now_s: float) -> Optional[Finding]:
        silence = self._silence(self._since_s, now_s)
        return Finding(Event.SILENT, silence) if silence else None

    def _silence(self, since_s: float, now_s: float) -> str:
        if now_s - max(self.odometry.heard_s, since_s) <= ODOMETRY_SILENCE_S:
            return ""
        return f"no fresh odometry on {self._topic}"

    def _steering(self) -> float:
        """From the odometry; where a yaw rate cannot tell, what was asked for."""
        centre_rad = self.odometry.centre_rad()
        if centre_rad is None:
            centre_rad = self._spec.centre_rad(self.set_point.inner_rad)
        return self.similarity.steering(centre_rad)


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
            self._node = ros.Ros2Node(self._session, settings.namespace)
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

    def _leave(self) -> None:
        try:
            if self.rejected:
                log.event("info", "ros2_odometry_rejected", **self.rejected)
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
