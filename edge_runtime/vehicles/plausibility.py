"""Whether a vehicle can be believed: silent, impossible, or not following. Pure."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Deque, Optional, Tuple

from edge_runtime.controller import Limits
from edge_runtime.safety import SILENCE_PERIODS

if TYPE_CHECKING:
    from edge_runtime.vehicles.base import VehicleReport

PEDAL = "pedal"
SILENT, STUCK, LYING = "vehicle_silent", "vehicle_stuck", "vehicle_lying"
BRAKING = "vehicle_self_braking"
ENABLE_TIMEOUT_S = 1.0  # a vehicle may take so long to confirm that it is enabled
LAG_S = 0.3  # an actuator may still follow a command of this age
DEVIATION = 0.125  # of an action's range, outside of all that was asked within LAG_S
DEVIATES_S = 0.1  # for this long without a break
MAX_ACCELERATION_MPS2 = 15.0  # no tyre gives more, on dry asphalt and without wings
SPEED_NOISE_MPS = 0.5
_ROUNDING = 5e-4  # of an action's range


class VehicleWatch:
    """Told every command and report; `fault` says what is wrong. Not thread-safe."""

    def __init__(self, control_period_s: float, limits: Limits) -> None:
        self._silence_s, self._limits = 2 * control_period_s, limits
        self._brakes_s = SILENCE_PERIODS * control_period_s
        self._drives, self._enabled_s, self._braking_since_s = False, -math.inf, math.inf
        self._asked: deque[tuple[float, dict[str, float]]] = deque()
        self._reported_s: Optional[float] = None
        self._believed: Optional[tuple[float, float]] = None  # time, speed of the last possible one
        self._deviates_since_s = math.inf
        self._lies = False

    @property
    def silent_at_s(self) -> float:
        """When it counts as silent if no further report comes; inf before the first report."""
        return math.inf if self._reported_s is None else self._reported_s + self._silence_s

    def begin(self, now_s: float) -> None:
        """From now on it owes reports."""
        self._reported_s = now_s

    def enable(self, now_s: float) -> None:
        """It is asked to take control: until it has, it brakes by itself."""
        self._enabled_s = now_s

    def command(self, action: dict[str, float], now_s: float, drives: bool = True) -> None:
        """Note what was asked; of a safe stop, too."""
        self._drives = drives
        self._asked.append((now_s, action))
        # One entry older than LAG_S stays: it was in force when the window began.
        while len(self._asked) > 1 and self._asked[1][0] < now_s - LAG_S:
            self._asked.popleft()

    def report(self, report: VehicleReport, now_s: float) -> None:
        """Note what the vehicle says of itself."""
        self._lies = self._is_impossible(report, now_s)
        if not self._lies:
            self._believed = (now_s, report.speed_mps)
        self._reported_s = now_s
        deviates = self._deviates(report, now_s)
        self._deviates_since_s = min(self._deviates_since_s, now_s) if deviates else math.inf
        if not report.self_braking:
            self._enabled_s = -math.inf  # it has taken control
        brakes = self._drives and report.self_braking
        self._braking_since_s = min(self._braking_since_s, now_s) if brakes else math.inf

    def fault(self, now_s: float) -> str:
        """SILENT, LYING, BRAKING, STUCK, or empty where nothing is wrong."""
        if now_s > self.silent_at_s:
            return SILENT
        if self._lies:
            return LYING
        if now_s - max(self._braking_since_s, self._enabled_s + ENABLE_TIMEOUT_S) > self._brakes_s:
            return BRAKING  # it obeys nobody, and would drive off with the next command
        return STUCK if now_s - self._deviates_since_s > DEVIATES_S else ""

    def _is_impossible(self, report: VehicleReport, now_s: float) -> bool:
        for name, value in report.action.items():
            low, high = self._range(name)
            slack = _ROUNDING * (high - low)
            if not low - slack <= value <= high + slack:  # NaN is in no range
                return True
        if not math.isfinite(report.speed_mps):
            return True
        # From the last possible report on: a leap is a lie until that speed could be real.
        since_s, speed_mps = self._believed or (now_s, report.speed_mps)
        most_mps = SPEED_NOISE_MPS + MAX_ACCELERATION_MPS2 * (now_s - since_s)
        return abs(report.speed_mps - speed_mps) > most_mps

    def _deviates(self, report: VehicleReport, now_s: float) -> bool:
        if not self._asked or report.self_braking or self._asked[0][0] > now_s - LAG_S:
            return False  # it obeys no command yet, or has had no time to
        for name, value in report.action.items():
            if name == PEDAL and report.commanded_speed_mps is not None:
                continue  # worked out from a speed, whose limits it cannot know: the driver judges
            asked = [action[name] for _, action in self._asked if name in action]
            low, high = self._range(name)
            most = DEVIATION * (high - low)
            if asked and not min(asked) - most <= value <= max(asked) + most:
                return True
        return False

    def _range(self, name: str) -> tuple[float, float]:
        """Of an action of the vehicle; it may report more than it takes, in -1 to 1."""
        limit = self._limits.get(name)
        return (-1.0, 1.0) if limit is None else (limit.low, limit.high)


class FollowWatch:
    """Whether what is measured stays outside of all that a healthy actuator can do.

    It is, give or take `tolerance`, where it was asked to be within `follows_s`. At first, or where
    it was not judged for a time, it comes from elsewhere: by `rate` a second.
    """

    def __init__(self, tolerance: float, follows_s: float, rate: float = 1e9) -> None:
        self._tolerance, self._follows_s, self._rate = tolerance, follows_s, rate
        self._asked: Deque[Tuple[float, float]] = deque()
        self._low = self._high = 0.0  # a healthy one is in between
        self._deviates_since_s = math.inf

    def is_stuck(self, asked: float, measured: Optional[float], now_s: float) -> bool:
        """Note what is asked and measured now, and judge; a None is not judged."""
        if measured is None:
            self._asked.clear()
            return False
        nearer = self._rate * (now_s - self._asked[-1][0]) if self._asked else 0.0
        self._asked.append((now_s, asked))
        while len(self._asked) > 1 and self._asked[1][0] < now_s - self._follows_s:
            self._asked.popleft()
        if self._asked[0][0] > now_s - self._follows_s:
            self._low, self._high, self._deviates_since_s = measured, measured, math.inf
            return False  # it has had no time to follow
        values = [value for _, value in self._asked]
        self._low = min(*values, self._low + nearer)
        self._high = max(*values, self._high - nearer)
        follows = self._low - self._tolerance <= measured <= self._high + self._tolerance
        self._deviates_since_s = math.inf if follows else min(self._deviates_since_s, now_s)
        return now_s - self._deviates_since_s > DEVIATES_S
