"""How the driver sees a vehicle behind ROS 2: a pure state machine. LEADS_TO is all of it.

STOPPED is a latch: the chassis drives again by itself as soon as somebody sends it a speed. Only
ENABLE leads out.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Dict, List, NamedTuple, Optional

from edge_runtime.config import Ros2Settings
from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import (
    IMPOSSIBLE,
    SetPoint,
    Speeds,
    SpeedWatch,
    Wish,
    steering_of,
    wish_of,
)
from edge_runtime.vehicles.mapping import HunterSpec, Similarity
from edge_runtime.vehicles.ros2.names import STEERING
from edge_runtime.vehicles.stream import COMMAND_TIMEOUT_S, Core
from edge_runtime.wire import CONTROL_PERIOD_S


class State(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class Event(str, Enum):
    """What can happen. All after CLOSE are what the odometry or time do."""

    ENABLE = "enable"
    BRAKE = "brake"
    CLOSE = "close"
    CONFIRMED = "confirmed"  # fresh odometry
    NOT_CONFIRMED = "not_confirmed"  # within ENABLE_TIMEOUT_S
    COMMAND_LATE = "command_late"  # no fresh command for 2 T
    SILENT = "odometry_silent"
    LYING = "odometry_impossible"
    STUCK = "speed_stuck"


_D, _G, _E, _X = State.DISABLED, State.ENABLING, State.ENABLED, State.STOPPED

# By the state before. A state that is not named stays as it is.
LEADS_TO: Dict[Event, Dict[State, State]] = {
    Event.ENABLE: {_D: _G, _E: _G, _X: _G},
    Event.BRAKE: {_G: _X, _E: _X},
    Event.CLOSE: {_G: _D, _E: _D, _X: _D},
    Event.CONFIRMED: {_G: _E},
    Event.NOT_CONFIRMED: {_G: _X},
    Event.COMMAND_LATE: {_E: _X},  # while ENABLING nothing moves yet
    Event.SILENT: {_E: _X},  # while ENABLING that is what is to be ended
    Event.LYING: {_G: _X, _E: _X},
    Event.STUCK: {_E: _X},
}


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


ODOMETRY_SILENCE_S = 2 * CONTROL_PERIOD_S
ENABLE_TIMEOUT_S = 1.0


class Motion(NamedTuple):
    """What the vehicle is told: `centre_rad` of the front wheels, positive to the left."""

    speed_mps: float
    centre_rad: float


class Ros2Core(Core):
    """The state machine, what was heard, and what is asked for."""

    def __init__(self, settings: Ros2Settings, spec: HunterSpec, similarity: Similarity) -> None:
        self.state: State = State.DISABLED
        self.cause: Optional[Event] = None  # what stopped it
        self.words = ""  # the same for a person; empty where our own side asked for the stop
        self.odometry = OdometryReports(settings, spec)
        self._topic = settings.odometry_topic
        self._spec, self._similarity = spec, similarity
        self._set_point = SetPoint(spec, similarity)
        self._speed_watch = SpeedWatch(spec.max_speed_mps)
        self._wish: Optional[Wish] = None  # None: stand
        self._wished_s = self._ticked_s = -math.inf
        self._since_s = -math.inf  # when this state began

    def enable(self, now_s: float) -> None:
        """Drive again as soon as fresh odometry shows that somebody is there."""
        self._wish = None
        self._set_point.stand()
        self._speed_watch.begin()
        self.odometry.begin()
        self._apply(Event.ENABLE, "", now_s)
        self._since_s = now_s

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """The newest command; forgotten where it may not drive. ValueError: see `wish_of`."""
        wish = wish_of(action, scenario_speed_mps)
        if self.state is State.ENABLED:
            self._wish, self._wished_s = wish, now_s

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Speed 0 at the next tick, until the next command or (latched) the next `enable`."""
        self._wish = None
        self._set_point.stand()
        if latch:
            self._apply(Event.BRAKE, "", now_s)

    def close(self, now_s: float) -> None:
        """Nothing more is sent."""
        self._apply(Event.CLOSE, "", now_s)

    def hear(self, measured: Measured, now_s: float) -> None:
        """An odometry message whose numbers are finite."""
        if not self.odometry.hear(measured, now_s):
            return
        if self.odometry.is_impossible:
            self._apply(Event.LYING, f"the odometry says {measured.speed_mps:.2f} m/s", now_s)
        elif self.state is State.ENABLING:
            self._apply(Event.CONFIRMED, "", now_s)

    @property
    def late_at_s(self) -> float:
        """After which moment its newest command is too old to be obeyed; inf where it has none."""
        return math.inf if self._wish is None else self._wished_s + COMMAND_TIMEOUT_S

    def tick(self, now_s: float) -> Optional[Motion]:
        """What to publish now; None while DISABLED."""
        self._watch(now_s)
        if self.state is State.DISABLED:
            return None
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.state is State.ENABLED and self._wish is not None:
            self._set_point.follow(self._wish, step_s, self.odometry.speed_mps)
        else:
            self._set_point.stand()
        return Motion(self._set_point.speed_mps, self._asked_centre_rad())

    def report(self, now_s: float) -> VehicleReport:
        """What the vehicle does, in the policy's terms and in its own."""
        speed_mps = self.odometry.speed_mps
        return VehicleReport(
            action={"pedal": self._pedal(), "steering": self._steering()},
            speed_mps=speed_mps,
            self_braking=self.state is not State.ENABLED,
            faults=self._faults(now_s),
            standing=self.standing(now_s),
            scenario_speed_mps=self._similarity.scenario_mps(speed_mps),
            commanded_speed_mps=self._set_point.speed_mps,
        )

    def standing(self, now_s: float) -> List[str]:
        """What would make an `enable` now be in vain, in words."""
        if self.state not in (State.STOPPED, State.DISABLED):
            return []
        silence = self._silence(-math.inf, now_s)
        return [silence] if silence else []

    def is_at_rest(self, now_s: float) -> bool:
        """Whether the vehicle is known to stand, or nothing was ever asked of it."""
        is_fresh = not self._silence(-math.inf, now_s)
        return self.state is State.DISABLED or (is_fresh and self.odometry.stands)

    def _apply(self, event: Event, words: str, now_s: float) -> None:
        after = LEADS_TO[event].get(self.state, self.state)
        if after is self.state:
            return
        if after is State.STOPPED:
            self._wish = None
            self._set_point.stand()
            self.cause, self.words = event, words
        else:
            self.cause, self.words = None, ""
        self.state, self._since_s = after, now_s

    def _watch(self, now_s: float) -> None:
        """What time alone tells."""
        if self.state is State.ENABLING and now_s - self._since_s > ENABLE_TIMEOUT_S:
            words = f"no odometry on {self._topic} within {ENABLE_TIMEOUT_S:.0f} s"
            self._apply(Event.NOT_CONFIRMED, words, now_s)
        if self.state is not State.ENABLED:
            return
        asked_mps, measured_mps = self._set_point.speed_mps, self.odometry.speed_mps
        is_stuck = self._speed_watch.is_stuck(asked_mps, measured_mps, now_s)
        silence = self._silence(self._since_s, now_s)
        if silence:
            self._apply(Event.SILENT, silence, now_s)
        elif self._wish is not None and now_s - self._wished_s > COMMAND_TIMEOUT_S:
            self._apply(Event.COMMAND_LATE, f"no command for {COMMAND_TIMEOUT_S:.2f} s", now_s)
        elif is_stuck:
            words = f"the speed stays at {measured_mps:.2f} m/s, asked for {asked_mps:.2f}"
            self._apply(Event.STUCK, words, now_s)

    def _silence(self, since_s: float, now_s: float) -> str:
        if now_s - max(self.odometry.heard_s, since_s) <= ODOMETRY_SILENCE_S:
            return ""
        return f"no fresh odometry on {self._topic}"

    def _faults(self, now_s: float) -> List[str]:
        if self.state is not State.STOPPED:
            return []
        words = [self.words] if self.words else []
        return words + [more for more in self.standing(now_s) if more not in words]

    def _asked_centre_rad(self) -> float:
        spec = self._spec
        return mapping.inner_to_centre(self._set_point.inner_rad, spec.wheelbase_m, spec.track_m)

    def _pedal(self) -> float:
        """From the measured acceleration; what stands, and is to stand, has its brake on."""
        if self.odometry.stands and self._set_point.speed_mps == 0.0:
            return -1.0
        acceleration_mps2 = self.odometry.acceleration_mps2()
        return mapping.acceleration_to_pedal(acceleration_mps2, self._similarity)

    def _steering(self) -> float:
        """From the odometry; where a yaw rate cannot tell, what was asked for."""
        centre_rad = self.odometry.centre_rad()
        if centre_rad is None:
            return steering_of(self._set_point.inner_rad, self._spec, self._similarity)
        return mapping.centre_to_steering(centre_rad, self._spec.wheelbase_m, self._similarity)
