"""The driver of a ROS 2 vehicle without clock, thread and network: odometry in, motion out.

Whoever holds it (vehicle.py, a test) serialises the calls, passes monotonic seconds, gives `hear`
every odometry, and publishes what `tick` returns, 50 times a second.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional

from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.hunter.set_point import SetPoint, SpeedWatch, Wish, steering_of, wish_of
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.interface import VehicleReport
from edge_runtime.vehicles.ros2.odometry import Measured, OdometryReports
from edge_runtime.vehicles.ros2.settings import Ros2Settings
from edge_runtime.vehicles.ros2.states import LEADS_TO, Event, State
from edge_runtime.vehicles.similarity import Similarity
from edge_runtime.vehicles.streamed import COMMAND_TIMEOUT_S, Core
from edge_runtime.wire import CONTROL_PERIOD_S

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
