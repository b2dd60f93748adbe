"""What the odometry says, and how old it is. No clock: monotonic seconds are passed in."""

from __future__ import annotations

import math
from collections import deque
from typing import Deque, NamedTuple, Optional, Tuple

from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.ros2.settings import STEERING, Ros2Settings
from edge_runtime.wire import CONTROL_PERIOD_S

STANDS_MPS = 0.02
# Below this the path's curvature, yaw rate over speed, is more noise than steering.
STEERS_FROM_MPS = 0.2
_IMPOSSIBLE = 1.3  # times what the vehicle can do


class Measured(NamedTuple):
    """One odometry message: `stamp_ns` by its sender's clock, `angular` as the settings say."""

    stamp_ns: int
    speed_mps: float
    angular: float


class OdometryReports:
    """The newest odometry, and the speeds of the last control period."""

    def __init__(self, settings: Ros2Settings, spec: HunterSpec) -> None:
        self.heard_s = -math.inf
        self.stale = 0  # repetitions and late ones: they show nobody alive
        self._newest: Optional[Measured] = None
        self._spec = spec
        self._is_angle = settings.odometry_angular == STEERING
        self._speeds: Deque[Tuple[float, float]] = deque()

    def begin(self) -> None:
        """Take whatever comes next: a clock on the other side may have been set back."""
        self._newest = None
        self._speeds.clear()

    def hear(self, measured: Measured, now_s: float) -> bool:
        """Note a message; False for one that is not newer than the last by its own stamp.

        A sender that leaves its stamps at 0 is believed by the time of arrival alone.
        """
        newest = self._newest
        if newest is not None and 0 < measured.stamp_ns <= newest.stamp_ns:
            self.stale += 1
            return False
        self._newest, self.heard_s = measured, now_s
        self._speeds.append((now_s, measured.speed_mps))
        while self._speeds[0][0] < now_s - CONTROL_PERIOD_S - 0.01:
            self._speeds.popleft()
        return True

    @property
    def speed_mps(self) -> float:
        """The newest speed, 0 before the first."""
        return self._newest.speed_mps if self._newest else 0.0

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return abs(self.speed_mps) < STANDS_MPS

    @property
    def is_impossible(self) -> bool:
        """Whether it says a speed that the vehicle cannot have."""
        return abs(self.speed_mps) > _IMPOSSIBLE * self._spec.max_speed_mps

    def acceleration_mps2(self) -> float:
        """Over the last control period; 0 while there is too little to tell."""
        if len(self._speeds) < 2:
            return 0.0
        (since_s, before_mps), (now_s, speed_mps) = self._speeds[0], self._speeds[-1]
        return (speed_mps - before_mps) / (now_s - since_s) if now_s > since_s else 0.0

    def centre_rad(self) -> Optional[float]:
        """The front wheels' centre angle; None where a yaw rate cannot tell it: it hardly moves."""
        if self._newest is None:
            return None
        if self._is_angle:
            return self._newest.angular
        if abs(self.speed_mps) < STEERS_FROM_MPS:
            return None
        return math.atan(self._spec.wheelbase_m * self._newest.angular / self.speed_mps)
