"""The driver of a vehicle behind ROS 2, without clock, thread and network: odometry in, motion out.

Pure. First what the odometry says and how old it is, then the core.
"""

from __future__ import annotations

import math
from typing import List, NamedTuple, Optional

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
from edge_runtime.vehicles.ros2.names import STEERING
from edge_runtime.wire import CONTROL_PERIOD_S

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
