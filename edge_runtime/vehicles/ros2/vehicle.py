"""The driver of a ROS 2 vehicle: a thread and a Zenoh session around core.py.

- The stream's thread publishes what `tick` gives, 50 times a second at absolute deadlines, and at
  once when somebody brakes.
- Zenoh's thread hands every odometry to `hear`.
All calls of the core hold one lock; nothing is published while it is held.
"""

from __future__ import annotations

import threading
import time
from typing import Callable, ClassVar, Dict, List, Optional

from edge_runtime import log
from edge_runtime.ros2 import messages as ros
from edge_runtime.ros2.endpoint import open_ros2_session
from edge_runtime.ros2.node import Ros2Node
from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.interface import ActionLimit, Vehicle, VehicleReport
from edge_runtime.vehicles.ros2.convert import drive_of, measured_of, twist_of
from edge_runtime.vehicles.ros2.core import Motion, Ros2Core
from edge_runtime.vehicles.ros2.settings import Ros2Settings, check_settings
from edge_runtime.vehicles.ros2.states import State
from edge_runtime.vehicles.similarity import Similarity
from edge_runtime.vehicles.stream import Stream

STOP_TAKES_S = 1.0  # zeros go out for so long at the end, unless it is known to stand before
# A pedal is integrated to a speed, so that any leap of it is a ramp: 2.0 in T = 0.1 s.
_PEDAL_SLEW_PER_S = 20.0


class Ros2Vehicle(Vehicle):
    """Opens its session and announces its topics when made; publishes nothing before `enable`.

    Raises UserError, when made, for settings that are not valid and for a busy port.
    """

    name: ClassVar[str] = "ros2"

    def __init__(self, settings: Ros2Settings, spec: HunterSpec, similarity: Similarity) -> None:
        check_settings(settings)
        self._settings, self._spec = settings, spec
        self._core = Ros2Core(settings, spec, similarity)
        self.limits: Dict[str, ActionLimit] = _limits(spec, similarity)
        self._lock = threading.Lock()
        self._closed = False
        self._logged = ""
        self._failing = False
        self._publish: List[Callable[[Motion], None]] = []
        # Needed: the vehicle's ROS driver makes a frame of each message, and has none of its own.
        self._stream = Stream("ros2-stream", self._send_due, self._late_at_s)
        self._session = open_ros2_session(settings.listen, settings.connect, "[ros2] listen")
        try:
            self._node = Ros2Node(self._session, settings.namespace)
            self._declare()
        except BaseException:
            self._session.close()  # An open session would hang the process at its exit.
            raise

    @property
    def state(self) -> State:
        """Where its state machine stands."""
        return self._core.state

    @property
    def rejected(self) -> Dict[str, int]:
        """Odometry that could not be read or was not new, by reason."""
        counts = dict(self._node.rejected)
        if self._core.odometry.stale:
            counts["stale"] = self._core.odometry.stale
        return counts

    def enable(self, now_s: float) -> None:
        """Publish speed 0, and drive once odometry comes; `feedback` tells whether it does."""
        if self._closed:
            return
        with self._lock:
            self._core.enable(now_s)
        self._stream.start()
        self._stream.wake()

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """A pedal, or the speed of the scenario's car; and a steering, which else stays."""
        with self._lock:
            self._core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Speed 0 leaves at once, not with the next period. ROS 2 has no message for a brake."""
        with self._lock:
            self._core.brake(now_s, latch)
        self._stream.wake()

    def feedback(self, now_s: float) -> VehicleReport:
        """From the newest odometry."""
        with self._lock:
            report = self._core.report(now_s)
        self._log_state()
        return report

    def close(self) -> None:
        """Publish speed 0 until it stands, and leave."""
        if self._closed:
            return
        self._closed = True
        self.brake(time.monotonic())
        self._stream.run_until(self._is_at_rest, STOP_TAKES_S)
        self._stream.stop()
        try:
            if self.rejected:
                log.event("info", "ros2_odometry_rejected", **self.rejected)
            gaps_ms = self._stream.gaps_ms()
            if gaps_ms:
                log.event("info", "ros2_stream", **gaps_ms)
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

    def _is_at_rest(self) -> bool:
        with self._lock:
            return self._core.is_at_rest(time.monotonic())

    def _late_at_s(self) -> float:
        with self._lock:
            return self._core.late_at_s

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

    def _log_state(self) -> None:
        """Each state once, when feedback is asked for: never from the stream's thread."""
        core = self._core
        line = f"{core.state.value} {core.words}".strip()
        if line != self._logged:
            self._logged = line
            is_bad = core.state is State.STOPPED and bool(core.words)
            level = "warning" if is_bad else "info"
            log.event(level, "ros2", state=core.state.value, why=core.words)


def _limits(spec: HunterSpec, similarity: Similarity) -> Dict[str, ActionLimit]:
    centre_rad = mapping.steering_to_centre(1.0, spec.wheelbase_m, similarity)
    full_rad = abs(
        mapping.centre_to_inner(
            centre_rad, spec.wheelbase_m, spec.track_m, spec.max_inner_steering_rad
        )
    )
    return {
        "pedal": ActionLimit(-1.0, 1.0, _PEDAL_SLEW_PER_S),
        "steering": ActionLimit(-1.0, 1.0, spec.max_steering_rate_radps / full_rad),
    }
