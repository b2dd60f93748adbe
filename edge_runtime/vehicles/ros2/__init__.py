"""A vehicle behind its own ROS 2 driver: standard messages on Zenoh. See README.md.

First names and settings; then what decides, pure: odometry in, motion out; then the session and two
threads around it:
- The stream's thread publishes what `tick` gives: the vehicle's ROS driver makes a frame of each
  message, and has no stream of its own.
- Zenoh's thread hands every odometry to `hear`.

node.py, which needs pycdr2, is imported when a session opens: settings are checked without it, too.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from typing import TYPE_CHECKING, Callable, ClassVar, List, NamedTuple, Optional, Type

from edge_runtime import log
from edge_runtime.config import check_choice
from edge_runtime.transport import check_endpoint, is_tls, open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.core import (
    Event,
    Speeds,
    State,
    StreamedCore,
)
from edge_runtime.vehicles.mapping import RobotSettings, Similarity
from edge_runtime.vehicles.plausibility import ENABLE_TIMEOUT_S, Fault, Finding, impossible
from edge_runtime.vehicles.stream import StreamedVehicle

if TYPE_CHECKING:
    from edge_runtime.vehicles.ros2.node import Odometry

# Beside our own 7447, where a bridge listens by default, too; and of this machine only.
DEFAULT_ROS2_ENDPOINT = "tcp/127.0.0.1:7448"
YAW_RATE, STEERING = "yaw_rate", "steering"
_ANGULAR = (YAW_RATE, STEERING)
_WORD = "[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(f"/|/?{_WORD}(/{_WORD})*")
_MAX_CHARS = 200

# Below this the path's curvature, yaw rate over speed, is more noise than steering.
STEERS_FROM_MPS = 0.2


def topic_key(namespace: str, topic: str) -> str:
    """The Zenoh key of a topic: below the namespace, or as it is where it begins with a slash.

    Raises UserError for names that ROS would not take.
    """
    for what, name in (("namespace", namespace), ("topic", topic)):
        if len(name) > _MAX_CHARS or not _NAME.fullmatch(name):
            raise UserError(
                f"{what} {name!r} is not valid: words of A-Z a-z 0-9 _ that begin with no digit,"
                f" between slashes, {_MAX_CHARS} characters at most, like /hunter01/odom"
            )
    whole = topic if topic.startswith("/") else f"{namespace}/{topic}"
    joined = "/".join(filter(None, whole.split("/")))
    if not joined:
        raise UserError(f"topic {topic!r} names nothing")
    return joined


class Ros2Settings(RobotSettings, frozen=True, kw_only=True):
    """`config.example.toml` documents each key. A topic that is empty is not published."""

    listen: Optional[str] = None
    connect: Optional[str] = None
    namespace: str = "/"
    twist_topic: str = "cmd_vel"
    twist_angular: str = YAW_RATE
    ackermann_topic: str = ""
    odometry_topic: str = "odom"
    odometry_angular: str = YAW_RATE

    def __post_init__(self) -> None:
        check_settings(self)


def check_settings(settings: Ros2Settings) -> None:
    """Raise UserError where the settings are not valid, or name nothing to be driven by."""
    for name in ("twist_angular", "odometry_angular"):
        check_choice(f"vehicle.ros2.{name}", getattr(settings, name), _ANGULAR)
    if settings.listen is not None and settings.connect is not None:
        raise UserError("ros2 has both listen and connect: give one of them")
    for endpoint in (settings.listen, settings.connect):
        if endpoint is not None and is_tls(check_endpoint(endpoint)):
            raise UserError(
                f"endpoint {endpoint} is not for the ROS 2 side: it speaks plain text, as DDS does;"
                " use tcp/ or udp/ on one machine, or inside a tunnel"
            )
    if not settings.twist_topic and not settings.ackermann_topic:
        raise UserError("ros2 has no topic to command by: set twist_topic or ackermann_topic")
    if not settings.odometry_topic:
        raise UserError("ros2 has no odometry_topic: without feedback nothing may drive")
    topics = [settings.twist_topic, settings.ackermann_topic, settings.odometry_topic]
    keys = [topic_key(settings.namespace, topic) for topic in topics if topic]
    if len(set(keys)) < len(keys):
        raise UserError(f"ros2 uses a topic twice: {', '.join(keys)}")


class Motion(NamedTuple):
    """What the vehicle is told: `centre_rad` of the front wheels, positive to the left."""

    speed_mps: float
    centre_rad: float


class Ros2Core(StreamedCore):
    """The state machine, what was heard, and what is asked for."""

    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        super().__init__(similarity, Speeds())
        self.stale = 0  # odometry that was repeated or came late: it shows nobody alive
        self._stamp_ns = 0  # of the newest, by its sender's clock
        self._angular: Optional[float] = None  # of the newest, as the settings say
        self._newest_s = -math.inf
        self._topic = settings.odometry_topic
        self._is_angle = settings.odometry_angular == STEERING

    def enable(self, now_s: float) -> None:
        """Drive again as soon as fresh odometry shows that the vehicle is there."""
        self._stamp_ns = 0  # whatever comes next counts: the sender's clock may have been set back
        self._angular = None
        self._heard.forget()
        super().enable(now_s)

    def close(self, now_s: float) -> None:
        """Nothing more is sent."""
        self._apply(Finding(Event.CLOSE, ""), now_s)

    def hear(self, stamp_ns: int, speed_mps: float, angular: float, now_s: float) -> None:
        """Finite odometry; it counts where it is newer than the last by its own stamp.

        A sender that leaves its stamps at 0 is believed by the time of arrival alone.
        """
        if 0 < stamp_ns <= self._stamp_ns:
            self.stale += 1
            # While nothing is driven, a clock set back is believed; a repetition is not.
            if self.state in (State.ENABLING, State.ENABLED) or stamp_ns == self._stamp_ns:
                return
        self._stamp_ns, self._angular, self._newest_s = stamp_ns, angular, now_s
        self._heard.note(speed_mps, now_s)
        words = impossible(speed_mps, angular if self._is_angle else 0.0, self._spec)
        lie = Finding(Fault.LYING, f"the odometry says {words}") if words else None
        self._apply(lie or Finding(Event.CONFIRMED, ""), now_s)

    def tick(self, now_s: float) -> Optional[Motion]:
        """What to publish now; None while DISABLED."""
        self._watch(now_s)
        if self.state is State.DISABLED:
            return None
        self._step(now_s)
        return Motion(self.set_point.speed_mps, self._asked_rad())

    def is_at_rest(self, now_s: float) -> bool:
        """Whether the vehicle is known to stand, or nothing was ever asked of it."""
        is_fresh = self._silence(-math.inf, now_s) is None
        return self.state is State.DISABLED or (is_fresh and self._heard.stands)

    def _why_not_confirmed(self, now_s: float) -> str:
        return f"no odometry on {self._topic} within {ENABLE_TIMEOUT_S:.0f} s"

    def _silence(self, since_s: float, now_s: float) -> Optional[Finding]:
        if now_s - max(self._newest_s, since_s) <= self._heard.silence_s:
            return None
        return Finding(Fault.SILENT, f"no fresh odometry on {self._topic}")

    def _centre_rad(self) -> Optional[float]:
        """From the odometry; None where a yaw rate tells nothing: it hardly moves."""
        angular, speed_mps = self._angular, self._heard.speed_mps
        if angular is None or self._is_angle:
            return angular
        if abs(speed_mps) < STEERS_FROM_MPS:
            return None
        return math.atan(self._spec.wheelbase_m * angular / speed_mps)


class Ros2Vehicle(StreamedVehicle):
    """Opens its session and announces its topics when made; publishes nothing before `enable`.

    Raises UserError, when made, for settings that are not valid and for a busy port.
    """

    name: ClassVar[str] = "ros2"
    settings_type: ClassVar[Type[RobotSettings]] = Ros2Settings

    def __init__(self, settings: Ros2Settings, similarity: Similarity) -> None:
        from edge_runtime.vehicles.ros2 import node as ros

        self._core: Ros2Core
        super().__init__(Ros2Core(settings, similarity))
        self._failing = False
        self._publish: List[Callable[[Motion], None]] = []
        # A router (by default on loopback), or a peer that goes on connecting to a bridge.
        connect, listen = settings.connect, None
        if connect is None:
            listen = settings.listen or DEFAULT_ROS2_ENDPOINT
        try:
            self._session = open_session(listen, connect, "peer" if connect else "router")
        except UserError as error:
            raise UserError(str(error).replace("--listen", "[vehicle.ros2] listen")) from None
        try:
            self._node = node = ros.Ros2Node(self._session, settings.namespace)
            if settings.twist_topic:
                twist = node.publisher(settings.twist_topic, ros.Twist)
                self._publish.append(
                    lambda motion: twist(
                        ros.twist_of(motion, settings.twist_angular, similarity.spec.wheelbase_m)
                    )
                )
            if settings.ackermann_topic:
                drive = node.publisher(settings.ackermann_topic, ros.AckermannDriveStamped)
                self._publish.append(lambda motion: drive(ros.drive_of(motion, time.time_ns())))
            node.subscribe(settings.odometry_topic, ros.Odometry, self._hear)
        except BaseException:
            self._session.close()  # An open session would hang the process at its exit.
            raise
        self._stream.start()

    def _leave(self) -> None:
        try:
            rejected = Counter({**self._node.rejected, "stale": self._core.stale})
            if rejected := +rejected:
                log.event("info", "ros2_odometry_rejected", **rejected)
            self._node.close()
        finally:
            with self._lock:
                self._core.close(time.monotonic())
            self._session.close()

    def _hear(self, odometry: Odometry) -> None:
        stamp, twist = odometry.header.stamp, odometry.twist.twist
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        with self._lock:
            self._core.hear(stamp_ns, twist.linear.x, twist.angular.z, time.monotonic())

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
