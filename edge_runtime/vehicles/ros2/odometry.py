"""What the odometry says, and how old it is. No clock: monotonic seconds are passed in."""

from __future__ import annotations

import math
from typing import NamedTuple, Optional

from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.ros2.settings import STEERING, Ros2Settings
from edge_runtime.vehicles.speeds import IMPOSSIBLE, Speeds

# Below this the path's curvature, yaw rate over speed, is more noise than steering.
STEERS_FROM_MPS = 0.2


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
        self._speeds = Speeds()

    def begin(self) -> None:
        """Take whatever comes next: a clock on the other side may have been set back."""
        self._newest = None
        self._speeds.forget()

    def hear(self, measured: Measured, now_s: float) -> bool:
        """Note a message; False for one that is not newer than the last by its own stamp.

        A sender that leaves its stamps at 0 is believed by the time of arrival alone.
        """
        newest = self._newest
        if newest is not None and 0 < measured.stamp_ns <= newest.stamp_ns:
            self.stale += 1
            return False
        self._newest, self.heard_s = measured, now_s
        self._speeds.note(measured.speed_mps, now_s)
        return True

    @property
    def speed_mps(self) -> float:
        """The newest speed, 0 before the first."""
        return self._speeds.newest_mps

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return self._speeds.stands

    @property
    def is_impossible(self) -> bool:
        """Whether it says a speed that the vehicle cannot have."""
        return abs(self.speed_mps) > IMPOSSIBLE * self._spec.max_speed_mps

    def acceleration_mps2(self) -> float:
        """Over the last control period; 0 while there is too little to tell."""
        return self._speeds.acceleration_mps2()

    def centre_rad(self) -> Optional[float]:
        """The front wheels' centre angle; None where a yaw rate cannot tell it: it hardly moves."""
        if self._newest is None:
            return None
        if self._is_angle:
            return self._newest.angular
        if abs(self.speed_mps) < STEERS_FROM_MPS:
            return None
        return math.atan(self._spec.wheelbase_m * self._newest.angular / self.speed_mps)
