"""Check a vehicle's reports for silence, lies and stuck actuators. Pure: time is passed in.

`VehicleWatch` sees the commands and reports of any driver. `DriveWatch` sees set-point and feedback
of a streamed vehicle, in m/s and rad; so it finds a steering that does not follow.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import Any, Deque, Dict, List, NamedTuple, Optional, Sequence, Tuple

from edge_runtime.controller import Limits
from edge_runtime.safety import SILENCE_PERIODS
from edge_runtime.vehicles.mapping import HunterSpec

PEDAL = "pedal"
ENABLE_TIMEOUT_S = 1.0  # a vehicle may take so long to confirm that it is enabled
DEVIATES_S = 0.1  # an actuator that deviates for this long without a break is stuck

# Any driver: an actuator may be at what was asked within LAG_S, give or take a share of its range.
LAG_S = 0.3
LAG_DEVIATION = 0.125
MAX_ACCELERATION_MPS2 = 15.0  # no tyre gives more, on dry asphalt and without wings
SPEED_NOISE_MPS = 0.5
OVER_CAP, OVER_CAP_MPS = 1.1, 0.02  # a speed over cap * OVER_CAP + OVER_CAP_MPS breaks the cap
_ROUNDING = 5e-4  # of an action's range

# A streamed vehicle: how long its speed may trail a set-point, and its wheels, by their dead time
# and lag (feedback is older still); tolerance as a share of top speed or of full lock.
FOLLOWS_S = 1.0
STEERS_S = 0.2
DEVIATION = 0.1
IMPOSSIBLE = 1.3  # times what the model can do


class VehicleReport(NamedTuple):
    """What the vehicle does. `action` is what its actuators have reached, in the units of `limits`.

    `faults` say in words why it does not drive, until it is enabled again; `standing` are those
    whose cause is there now. A vehicle that takes a speed instead of a pedal reports two speeds
    more: its speed at the scenario's scale, and the one that it is asked for (its own m/s).
    """

    action: Dict[str, float]
    speed_mps: float
    self_braking: bool
    faults: List[str]
    standing: Sequence[str] = ()
    scenario_speed_mps: Optional[float] = None
    commanded_speed_mps: Optional[float] = None
    battery_v: Optional[float] = None


class Fault(str, Enum):
    """The values are what feedback and health say where `VehicleWatch` finds the fault."""

    SILENT = "vehicle_silent"  # feedback that was due is missing, or repeats itself
    LYING = "vehicle_lying"  # it reports the impossible
    STUCK = "vehicle_stuck"  # its speed, or an action of any driver
    STEERING_STUCK = "steering_stuck"
    SELF_BRAKING = "vehicle_self_braking"  # though it is to drive
    TOO_FAST = "vehicle_too_fast"  # for the operator's speed cap, while it is to drive


class Finding(NamedTuple):
    """A fault, or another event of a streamed vehicle; `words` are empty for a requested event."""

    event: Enum
    words: str = ""


def lasting(since_s: float, holds: bool, now_s: float) -> float:
    """Return since when a condition has held at every look; inf where it does not hold."""
    return min(since_s, now_s) if holds else math.inf


class Asked:
    """What was asked within `window_s` of the newest, and what was in force when that began."""

    def __init__(self, window_s: float) -> None:
        self._window_s = window_s
        self.noted: Deque[Tuple[float, Any]] = deque()

    def note(self, asked: Any, now_s: float) -> None:
        self.noted.append((now_s, asked))
        while len(self.noted) > 1 and self.noted[1][0] < now_s - self._window_s:
            self.noted.popleft()

    def is_full(self, now_s: float) -> bool:
        return bool(self.noted) and self.noted[0][0] <= now_s - self._window_s

    @property
    def values(self) -> List[Any]:
        return [asked for _, asked in self.noted]


class VehicleWatch:
    """Watch the commands and reports of any driver. Not thread-safe."""

    def __init__(
        self, control_period_s: float, limits: Limits, max_speed_mps: float = math.inf
    ) -> None:
        self._most_mps = OVER_CAP * max_speed_mps + OVER_CAP_MPS
        self._silence_s, self._limits = 2 * control_period_s, limits
        self._brakes_s = SILENCE_PERIODS * control_period_s
        self._drives, self._enabled_s = False, -math.inf
        self._brakes_since_s = self._deviates_since_s = math.inf
        self._asked = Asked(LAG_S)
        self._reported_s = math.inf  # until it owes a report
        self._believed: Optional[Tuple[float, float]] = None  # time, speed of the last possible one
        self._lies = self._races = False

    @property
    def silent_at_s(self) -> float:
        """When it counts as silent if no further report comes; inf before `begin`."""
        return self._reported_s + self._silence_s

    def begin(self, now_s: float) -> None:
        self._reported_s = now_s

    def enable(self, now_s: float) -> None:
        """Note that the driver is asked to take control: until it has, it brakes by itself."""
        self._enabled_s = now_s

    def command(self, action: Dict[str, float], now_s: float, drives: bool = True) -> None:
        """Note what was asked; `drives` is False for a safe stop, which brakes whatever is asked.

        The pedal may then also be where the action puts it, if the action has a pedal.
        """
        self._drives = drives
        if not drives:
            lowest, _ = self._range(PEDAL)
            self._asked.note({PEDAL: lowest, **action}, now_s)
            action = {**action, PEDAL: lowest}
        self._asked.note(action, now_s)

    def report(self, report: VehicleReport, now_s: float) -> None:
        self._lies = self._is_impossible(report, now_s)
        if not self._lies:
            self._believed = (now_s, report.speed_mps)
        self._races = self._drives and abs(report.speed_mps) > self._most_mps
        self._reported_s = now_s
        is_astray = self._is_astray(report, now_s)
        self._deviates_since_s = lasting(self._deviates_since_s, is_astray, now_s)
        if not report.self_braking:
            self._enabled_s = -math.inf  # it has taken control
        brakes = self._drives and report.self_braking
        self._brakes_since_s = lasting(self._brakes_since_s, brakes, now_s)

    def fault(self, now_s: float) -> Optional[Fault]:
        if now_s > self.silent_at_s:
            return Fault.SILENT
        if self._lies:
            return Fault.LYING
        if self._races:
            return Fault.TOO_FAST
        may_brake_until_s = max(self._brakes_since_s, self._enabled_s + ENABLE_TIMEOUT_S)
        if now_s - may_brake_until_s > self._brakes_s:
            return Fault.SELF_BRAKING  # it obeys nobody, and would drive off with the next command
        return Fault.STUCK if now_s - self._deviates_since_s > DEVIATES_S else None

    def _is_impossible(self, report: VehicleReport, now_s: float) -> bool:
        for name, value in report.action.items():
            low, high = self._range(name)
            slack = _ROUNDING * (high - low)
            if not low - slack <= value <= high + slack:  # NaN is in no range
                return True
        # Since the last possible report: a leap is a lie until the speed can have been reached.
        since_s, speed_mps = self._believed or (now_s, report.speed_mps)
        most_mps = SPEED_NOISE_MPS + MAX_ACCELERATION_MPS2 * (now_s - since_s)
        return not abs(report.speed_mps - speed_mps) <= most_mps  # also for NaN, and inf - inf

    def _is_astray(self, report: VehicleReport, now_s: float) -> bool:
        if report.self_braking or not self._asked.is_full(now_s):
            return False  # it obeys no command yet, or has had no time to
        for name, value in report.action.items():
            if name == PEDAL and report.commanded_speed_mps is not None:
                continue  # derived from a speed, which the driver itself judges
            asked = [action.get(name) for action in self._asked.values]
            if None in asked:
                continue  # in a drive, the policy does not command this action
            low, high = self._range(name)
            most = LAG_DEVIATION * (high - low)
            if not min(asked) - most <= value <= max(asked) + most:
                return True
        return False

    def _range(self, name: str) -> Tuple[float, float]:
        """Return the range of an action; one that the vehicle does not take lies in -1 to 1."""
        limit = self._limits.get(name)
        return (-1.0, 1.0) if limit is None else (limit.low, limit.high)


class FollowWatch:
    """Watch whether a measured value stays outside of a healthy actuator's band.

    The band spans all that was asked within `follows_s`, widened by `tolerance`. At first, or after
    a time without judgement, it begins at the measured value and moves by `rate` a second.
    """

    def __init__(self, tolerance: float, follows_s: float, rate: float = 1e9) -> None:
        self._tolerance, self._rate = tolerance, rate
        self._asked = Asked(follows_s)
        self._low = self._high = 0.0  # a healthy one is in between
        self._deviates_since_s = math.inf

    def is_stuck(self, asked: float, measured: Optional[float], now_s: float) -> bool:
        """Note what is asked and measured now, and judge; a None is not judged."""
        if measured is None:
            self._asked.noted.clear()
            return False
        noted = self._asked.noted
        nearer = self._rate * (now_s - noted[-1][0]) if noted else 0.0
        self._asked.note(asked, now_s)
        if not self._asked.is_full(now_s):  # it has had no time to follow
            self._low = self._high = measured
            self._deviates_since_s = math.inf
            return False
        self._low = min(*self._asked.values, self._low + nearer)
        self._high = max(*self._asked.values, self._high - nearer)
        follows = self._low - self._tolerance <= measured <= self._high + self._tolerance
        self._deviates_since_s = lasting(self._deviates_since_s, not follows, now_s)
        return now_s - self._deviates_since_s > DEVIATES_S


class DriveWatch:
    """Watch whether a streamed vehicle follows its set-point. Feedback may be `silence_s` old."""

    def __init__(self, spec: HunterSpec, silence_s: float) -> None:
        full_rad = spec.centre_rad(spec.max_inner_steering_rad)
        rate_radps, steers_s = spec.max_steering_rate_radps, STEERS_S + silence_s
        self._speed = FollowWatch(DEVIATION * spec.max_speed_mps, FOLLOWS_S)
        self._steering = FollowWatch(DEVIATION * full_rad, steers_s, rate_radps)

    def stuck(
        self, asked: Tuple[float, float], measured: Tuple[float, Optional[float]], now_s: float
    ) -> Optional[Finding]:
        """Note speed (m/s) and centre angle (rad; measured: None is not judged), and judge."""
        (asked_mps, asked_rad), (speed_mps, turned_rad) = asked, measured
        speed_is_stuck = self._speed.is_stuck(asked_mps, speed_mps, now_s)
        if self._steering.is_stuck(asked_rad, turned_rad, now_s) and not speed_is_stuck:
            words = f"the steering stays at {turned_rad:.2f} rad, asked for {asked_rad:.2f}"
            return Finding(Fault.STEERING_STUCK, words)
        words = f"the speed stays at {speed_mps:.2f} m/s, asked for {asked_mps:.2f}"
        return Finding(Fault.STUCK, words) if speed_is_stuck else None


def impossible(speed_mps: float, inner_rad: float, spec: HunterSpec) -> str:
    """Return the value that no vehicle of the model can reach, in words; empty if none."""
    if abs(speed_mps) > IMPOSSIBLE * spec.max_speed_mps:
        return f"{speed_mps:.1f} m/s"
    if abs(inner_rad) > IMPOSSIBLE * spec.max_inner_steering_rad:
        return f"a steering angle of {inner_rad:.2f} rad"
    return ""
