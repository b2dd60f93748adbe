"""The speed and the angle that the chassis is told: from the newest command, step by step. Pure."""

from __future__ import annotations

import math
from collections import deque
from typing import Deque, Dict, NamedTuple, Optional, Tuple

from edge_runtime.controller import ActionLimit
from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.wire import CONTROL_PERIOD_S

_LONGEST_STEP_S = CONTROL_PERIOD_S  # after a pause of the process the pedal was not held for it
# A pedal is integrated to a speed, so that any leap of it is a ramp.
_PEDAL_SLEW_PER_S = math.inf

FOLLOWS_S = 10 * CONTROL_PERIOD_S  # a drive may still follow a set-point of this age
DEVIATION = 0.1  # of top speed, outside of all that was asked within FOLLOWS_S
DEVIATES_S = CONTROL_PERIOD_S


class Wish(NamedTuple):
    """A command: the pedal, or the speed of the scenario's car; the steering stays where None."""

    pedal: Optional[float]
    scenario_speed_mps: Optional[float]
    steering: Optional[float]


def wish_of(action: Dict[str, float], scenario_speed_mps: Optional[float]) -> Wish:
    """The command of an action, within -1 to 1.

    Raises ValueError for what is not finite, and for what leaves out how fast to drive.
    """
    wish = Wish(action.get("pedal"), scenario_speed_mps, action.get("steering"))
    if not all(math.isfinite(value) for value in wish if value is not None):
        raise ValueError(f"a command that is not finite: {action}, {scenario_speed_mps} m/s")
    if not action or (wish.pedal is None and scenario_speed_mps is None):
        raise ValueError(f"a command that lacks an action: {action}, {scenario_speed_mps} m/s")
    return Wish(_within(wish.pedal), scenario_speed_mps, _within(wish.steering))


def _within(action: Optional[float]) -> Optional[float]:
    """A pedal of 1e308 times a step of 0 s is no number."""
    return None if action is None else min(max(action, -1.0), 1.0)


class SetPoint:
    """`speed_mps` and `inner_rad` are within the model's limits at all times."""

    def __init__(self, spec: HunterSpec, similarity: Similarity) -> None:
        self.speed_mps = 0.0
        self.inner_rad = 0.0
        self._spec, self._similarity = spec, similarity

    def stand(self) -> None:
        """Speed 0 at once, the angle held."""
        self.speed_mps = 0.0

    def follow(self, wish: Wish, step_s: float, measured_mps: float) -> None:
        """One step of time towards what is wished for."""
        spec, similarity = self._spec, self._similarity
        step_s = min(max(step_s, 0.0), _LONGEST_STEP_S)
        if wish.pedal is not None:
            self.speed_mps = mapping.pedal_to_speed(
                self.speed_mps, wish.pedal, step_s, measured_mps, spec.max_speed_mps, similarity
            )
        else:
            self.speed_mps = mapping.follow_speed(
                self.speed_mps,
                wish.scenario_speed_mps or 0.0,
                step_s,
                spec.max_speed_mps,
                similarity,
            )
        if wish.steering is not None:
            self._turn(inner_of(wish.steering, spec, similarity), step_s)

    def _turn(self, wanted_rad: float, step_s: float) -> None:
        most_rad = self._spec.max_steering_rate_radps * step_s
        change_rad = min(max(wanted_rad - self.inner_rad, -most_rad), most_rad)
        self.inner_rad += change_rad


def inner_of(steering: float, spec: HunterSpec, similarity: Similarity) -> float:
    """The inner wheel's angle for a steering in -1 to 1: all the steps of the mapping."""
    centre_rad = mapping.steering_to_centre(steering, spec.wheelbase_m, similarity)
    return mapping.centre_to_inner(
        centre_rad, spec.wheelbase_m, spec.track_m, spec.max_inner_steering_rad
    )


def limits_of(spec: HunterSpec, similarity: Similarity) -> Dict[str, ActionLimit]:
    """Ranges and slew rates of the actions: the steering's is that of the wheels."""
    full_rad = abs(inner_of(1.0, spec, similarity))
    return {
        "pedal": ActionLimit(-1.0, 1.0, _PEDAL_SLEW_PER_S),
        "steering": ActionLimit(-1.0, 1.0, spec.max_steering_rate_radps / full_rad),
    }


def steering_of(inner_rad: float, spec: HunterSpec, similarity: Similarity) -> float:
    """The steering in -1 to 1 for an inner wheel's angle, as the feedback says it."""
    centre_rad = mapping.inner_to_centre(inner_rad, spec.wheelbase_m, spec.track_m)
    return mapping.centre_to_steering(centre_rad, spec.wheelbase_m, similarity)


class SpeedWatch:
    """Whether the measured speed stays outside of every speed that was lately asked for."""

    def __init__(self, max_speed_mps: float) -> None:
        self._tolerance_mps = DEVIATION * max_speed_mps
        self._asked: Deque[Tuple[float, float]] = deque()
        self._deviates_since_s: Optional[float] = None

    def begin(self) -> None:
        """Forget what was asked before: it has a new chance to follow."""
        self._asked.clear()
        self._deviates_since_s = None

    def is_stuck(self, asked_mps: float, measured_mps: float, now_s: float) -> bool:
        """Note what is asked and measured now, and judge."""
        self._asked.append((now_s, asked_mps))
        while len(self._asked) > 1 and self._asked[1][0] < now_s - FOLLOWS_S:
            self._asked.popleft()
        if self._asked[0][0] > now_s - FOLLOWS_S:
            return False  # it has had no time to follow
        speeds = [speed for _, speed in self._asked]
        low, high = min(speeds) - self._tolerance_mps, max(speeds) + self._tolerance_mps
        if low <= measured_mps <= high:
            self._deviates_since_s = None
        elif self._deviates_since_s is None:
            self._deviates_since_s = now_s
        since_s = self._deviates_since_s
        return since_s is not None and now_s - since_s > DEVIATES_S


STANDS_MPS = 0.02
IMPOSSIBLE = 1.3
"""Times what the model can do: who reports more than that is not believed."""
_SLACK_S = 0.01


class Speeds:
    """Those of the last control period; monotonic seconds are passed in."""

    def __init__(self) -> None:
        self._noted: Deque[Tuple[float, float]] = deque()

    def note(self, speed_mps: float, now_s: float) -> None:
        """The newest one."""
        self._noted.append((now_s, speed_mps))
        while self._noted[0][0] < now_s - CONTROL_PERIOD_S - _SLACK_S:
            self._noted.popleft()

    def forget(self) -> None:
        """As before the first one."""
        self._noted.clear()

    @property
    def newest_mps(self) -> float:
        """0 before the first."""
        return self._noted[-1][1] if self._noted else 0.0

    @property
    def stands(self) -> bool:
        """Whether it stood when it was last heard."""
        return abs(self.newest_mps) < STANDS_MPS

    def acceleration_mps2(self) -> float:
        """Over the last control period; 0 while there is too little to tell."""
        if len(self._noted) < 2:
            return 0.0
        (since_s, before_mps), (now_s, speed_mps) = self._noted[0], self._noted[-1]
        return (speed_mps - before_mps) / (now_s - since_s) if now_s > since_s else 0.0
