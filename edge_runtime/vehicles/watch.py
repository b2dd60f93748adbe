"""Whether a vehicle can be believed: it reports, does what it is told, and reports what can be.

Pure: time is passed in as monotonic seconds. The limits are wide, because a false alarm stops a
vehicle as surely as a real one; what they catch is a vehicle that no longer answers to anybody.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Deque, Dict, Optional, Tuple

from edge_runtime.vehicles.interface import VehicleReport
from edge_runtime.wire import CONTROL_PERIOD_S

PEDAL = "pedal"
SILENT, STUCK, LYING = "vehicle_silent", "vehicle_stuck", "vehicle_lying"
SILENCE_S = 2 * CONTROL_PERIOD_S
LAG_S = 3 * CONTROL_PERIOD_S  # an actuator may still follow a command of this age
DEVIATION = 0.25  # of full pedal or steering, outside of all that was asked within LAG_S
DEVIATES_S = CONTROL_PERIOD_S  # for this long without a break
MAX_ACCELERATION_MPS2 = 15.0  # no tyre gives more, on dry asphalt and without wings
SPEED_NOISE_MPS = 0.5
_ROUNDING = 1e-3


class VehicleWatch:
    """Told every command and report; `fault` says what is wrong. Not thread-safe."""

    def __init__(self) -> None:
        self._asked: Deque[Tuple[float, Dict[str, float]]] = deque()
        self._reported_s: Optional[float] = None
        self._believed: Optional[Tuple[float, float]] = None  # time, speed of the last possible one
        self._deviates_since_s: Optional[float] = None
        self._lies = False

    @property
    def silent_at_s(self) -> float:
        """When it counts as silent if no further report comes; inf before the first report."""
        return math.inf if self._reported_s is None else self._reported_s + SILENCE_S

    def begin(self, now_s: float) -> None:
        """The vehicle is enabled: from now on it owes reports."""
        self._reported_s = now_s

    def command(self, action: Dict[str, float], now_s: float) -> None:
        """Note what was asked; the pedal of a safe stop is -1."""
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
        if not self._deviates(report, now_s):
            self._deviates_since_s = None
        elif self._deviates_since_s is None:
            self._deviates_since_s = now_s

    def fault(self, now_s: float) -> str:
        """SILENT, LYING, STUCK, or empty where nothing is wrong."""
        if now_s > self.silent_at_s:
            return SILENT
        if self._lies:
            return LYING
        since_s = self._deviates_since_s
        return STUCK if since_s is not None and now_s - since_s > DEVIATES_S else ""

    def _is_impossible(self, report: VehicleReport, now_s: float) -> bool:
        numbers = [report.speed_mps, *report.action.values()]
        if not all(map(math.isfinite, numbers)):
            return True
        if any(abs(value) > 1.0 + _ROUNDING for value in report.action.values()):
            return True
        if self._believed is None:
            return False
        # From the last possible report on: a leap is a lie until that speed could be real.
        since_s, speed_mps = self._believed
        most_mps = SPEED_NOISE_MPS + MAX_ACCELERATION_MPS2 * (now_s - since_s)
        return abs(report.speed_mps - speed_mps) > most_mps

    def _deviates(self, report: VehicleReport, now_s: float) -> bool:
        if not self._asked or report.self_braking or self._asked[0][0] > now_s - LAG_S:
            return False  # It obeys nobody yet, or has had no time to.
        for name, value in report.action.items():
            if name == PEDAL and report.commanded_speed_mps is not None:
                continue  # worked out from a speed, whose limits it cannot know: the driver judges
            asked = [action[name] for _, action in self._asked if name in action]
            if asked and not min(asked) - DEVIATION <= value <= max(asked) + DEVIATION:
                return True
        return False
