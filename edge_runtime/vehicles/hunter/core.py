"""The driver of a Hunter without clock, thread and bus: frames and time in, frames out.

Whoever holds it (vehicle.py, a test) serialises the calls, passes monotonic seconds, gives `hear`
every frame of the bus, and sends what `tick` returns, 50 times a second.
"""

from __future__ import annotations

import math
from typing import Dict, List, Optional

from edge_runtime.vehicles import mapping
from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.frames import Sent
from edge_runtime.vehicles.hunter.reports import Finding, Reports
from edge_runtime.vehicles.hunter.set_point import SetPoint, SpeedWatch, Wish, steering_of, wish_of
from edge_runtime.vehicles.hunter.specs import HunterSpec
from edge_runtime.vehicles.hunter.states import TRANSITIONS, Event, State
from edge_runtime.vehicles.interface import VehicleReport
from edge_runtime.vehicles.similarity import Similarity
from edge_runtime.vehicles.streamed import COMMAND_TIMEOUT_S, STOP_TAKES_S, Core

ENABLE_TIMEOUT_S = 1.0
ASK_AGAIN_S = 0.1  # a frame may be lost, and the chassis answers every 100 ms
BUS_PATIENCE_S = 0.1  # five frames of the stream
_STOPS_AT_ONCE = (Event.STUCK,)  # no set-point will stop it: the brake must


class HunterCore(Core):
    """The state machine, what was heard, and what is asked for."""

    def __init__(self, spec: HunterSpec, profile: str, similarity: Similarity) -> None:
        self.state: State = State.DISABLED
        self.cause: Optional[Event] = None  # what stopped it
        self.reports = Reports(spec, profile)
        self.set_point = SetPoint(spec, similarity)
        self._spec, self._similarity = spec, similarity
        self._speed_watch = SpeedWatch(spec.max_speed_mps)
        self.words = ""  # the same for a person; empty where our own side asked for the stop
        self._wish: Optional[Wish] = None  # None: stand
        self._wished_s = self._ticked_s = -math.inf
        self._since_s = -math.inf  # when this state began
        self._ask_s = math.inf  # when to ask the chassis for something next
        self._bus_words = ""  # empty while it works
        self._bus_failed_s: Optional[float] = None  # when the failures began

    def enable(self, now_s: float) -> None:
        """Ask for control, from now on until the chassis confirms it."""
        self._wish = None
        self._speed_watch.begin()
        self._ask_s = now_s
        self._apply(Finding(Event.ENABLE, ""), now_s)
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
        if latch:
            self._apply(Finding(Event.BRAKE, ""), now_s)

    def close(self, now_s: float) -> List[Sent]:
        """The last frames: stand, park, give control back. None where it was never taken."""
        if self.state is State.DISABLED:
            return []
        self.set_point.stand()
        parts = [self._motion(), _sent(frames.MODE_COMMAND, frames.ModeCommand(frames.STANDBY))]
        if not self.reports.remote_drives:
            parts.insert(1, _sent(frames.BRAKE_COMMAND, frames.BrakeCommand(1)))
        self._apply(Finding(Event.CLOSE, ""), now_s)
        return parts

    def hear(self, can_id: int, data: bytes, now_s: float) -> None:
        """A frame of the bus, whoever sent it; never raises."""
        if self.state is State.DISABLED:
            self.bus_works()  # nothing is sent then that it could take
        if self.is_command(can_id):
            self._apply(Finding(Event.FOREIGN, f"somebody else sends 0x{can_id:x}"), now_s)
            return
        self.reports.hear(can_id, data, now_s)
        if can_id == frames.SYSTEM_STATUS.can_id or can_id in frames.MOTOR_OF_SLOW:
            self._judge(now_s)
        elif can_id == frames.MOTION_STATUS.can_id:
            # At once, not with the next tick: else the runtime's own watch would stop it first,
            # and what it then says is over with the lie.
            self._apply_if_enabled(self.reports.lie(), now_s)

    def bus_failed(self, words: str, now_s: float, fatal: bool = False) -> None:
        """The bus did not take a frame, or gave none; `fatal`: it says that it is off."""
        if self._bus_failed_s is None:
            self._bus_failed_s = now_s
        if fatal or now_s - self._bus_failed_s > BUS_PATIENCE_S:
            self._bus_words = f"the CAN bus fails: {words}"
            self._apply(Finding(Event.BUS, self._bus_words), now_s)

    def bus_works(self) -> None:
        """The bus took a frame, or (while none is sent) gave one."""
        self._bus_failed_s, self._bus_words = None, ""

    @property
    def late_at_s(self) -> float:
        """After which moment its newest command is too old to be obeyed; inf where it has none."""
        return math.inf if self._wish is None else self._wished_s + COMMAND_TIMEOUT_S

    def tick(self, now_s: float) -> List[Sent]:
        """The frames to send now; none while DISABLED."""
        self._watch(now_s)
        if self.state is State.DISABLED:
            return []
        parts = self._requests(now_s) if now_s >= self._ask_s else []
        self._step(now_s)
        return [*parts, self._motion()]

    def report(self, now_s: float) -> VehicleReport:
        """What the vehicle does, in the policy's terms and in its own."""
        speed_mps = self.reports.speed_mps
        return VehicleReport(
            action={"pedal": self._pedal(), "steering": self._steering()},
            speed_mps=speed_mps,
            self_braking=self.state is not State.ENABLED,
            faults=self._faults(now_s),
            standing=self.standing(now_s),
            scenario_speed_mps=self._similarity.scenario_mps(speed_mps),
            commanded_speed_mps=self.set_point.speed_mps,
            battery_v=self.reports.status.battery_v if self.reports.status else None,
        )

    def standing(self, now_s: float) -> List[str]:
        """What would make an `enable` now be in vain, in words."""
        if self.state not in (State.STOPPED, State.DISABLED):
            return []
        found = [self.reports.commander(), self.reports.silence(-math.inf, now_s)]
        words = [finding.words for finding in found if finding is not None]
        return [*words, self._bus_words] if self._bus_words else words

    @staticmethod
    def is_command(can_id: int) -> bool:
        """Whether it is for the chassis, so that only we should send it."""
        return any(can_id == frame.can_id for frame in frames.COMMANDS)

    def is_at_rest(self, now_s: float) -> bool:
        """Whether the vehicle is known to stand, or nobody here can do more about it."""
        blind = self.state is State.DISABLED or bool(self._bus_words) or self.reports.remote_drives
        return blind or self.reports.is_known_to_stand(now_s)

    def _apply(self, finding: Finding, now_s: float) -> None:
        after = TRANSITIONS[self.state, finding.event]
        if after is self.state:
            return
        if after is State.STOPPED:
            self._wish = None
            self.set_point.stand()
            self.cause, self.words = finding.event, finding.words
            at_once = finding.event in _STOPS_AT_ONCE
            self._ask_s = now_s + (0.0 if at_once else STOP_TAKES_S)
        else:
            self.cause, self.words = None, ""
        if after is State.ENABLED:
            self._ask_s = math.inf
        self.state, self._since_s = after, now_s

    def _judge(self, now_s: float) -> None:
        """What the chassis's newest status means."""
        finding = self.reports.finding()
        if self.state is State.ENABLING and self.reports.status_s <= self._since_s:
            return  # from before it was asked
        self._apply(finding or Finding(Event.CONFIRMED, ""), now_s)

    def _watch(self, now_s: float) -> None:
        """What time alone tells."""
        if self.state is State.ENABLING and now_s - self._since_s > ENABLE_TIMEOUT_S:
            why = self.reports.silence(self._since_s, now_s) or self.reports.finding()
            words = f"not enabled within {ENABLE_TIMEOUT_S:.0f} s"
            self._apply(
                Finding(Event.NOT_CONFIRMED, f"{words}: {why.words}" if why else words), now_s
            )
        if self.state is not State.ENABLED:
            return
        found = self.reports.silence(self._since_s, now_s) or self.reports.lie()
        if found is None and self._wish is not None and now_s - self._wished_s > COMMAND_TIMEOUT_S:
            found = Finding(Event.COMMAND_LATE, f"no command for {COMMAND_TIMEOUT_S:.2f} s")
        asked_mps, measured_mps = self.set_point.speed_mps, self.reports.speed_mps
        if self._speed_watch.is_stuck(asked_mps, measured_mps, now_s) and found is None:
            words = f"the speed stays at {measured_mps:.2f} m/s, asked for {asked_mps:.2f}"
            found = Finding(Event.STUCK, words)
        self._apply_if_enabled(found, now_s)

    def _apply_if_enabled(self, finding: Optional[Finding], now_s: float) -> None:
        if finding is not None and self.state is State.ENABLED:
            self._apply(finding, now_s)

    def _requests(self, now_s: float) -> List[Sent]:
        """Beside the stream: for control while ENABLING, for the brake while STOPPED."""
        self._ask_s = now_s + ASK_AGAIN_S
        if self.state is State.STOPPED:
            # A person with the remote control knows better than we do.
            if self.reports.remote_drives or self.reports.is_known_to_stand(now_s):
                return []
            return [_sent(frames.BRAKE_COMMAND, frames.BrakeCommand(1))]
        parts = [
            _sent(frames.MODE_COMMAND, frames.ModeCommand(frames.CAN_CONTROL)),
            _sent(frames.BRAKE_COMMAND, frames.BrakeCommand(0)),
        ]
        if self.reports.needs_clearing:
            parts.insert(0, _sent(frames.CLEAR_COMMAND, frames.ClearCommand()))
        return parts

    def _step(self, now_s: float) -> None:
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.state is State.ENABLED and self._wish is not None:
            self.set_point.follow(self._wish, step_s, self.reports.speed_mps)
        else:
            self.set_point.stand()

    def _motion(self) -> Sent:
        speed_mps, inner_rad = self.set_point.speed_mps, self.set_point.inner_rad
        return Sent(frames.MOTION_COMMAND, frames.encode_motion(speed_mps, inner_rad, self._spec))

    def _faults(self, now_s: float) -> List[str]:
        if self.state is not State.STOPPED:
            return []
        words = [self.words] if self.words else []
        return words + [more for more in self.standing(now_s) if more not in words]

    def _pedal(self) -> float:
        """From the measured acceleration; the brake where it stands and is to stand."""
        if self.reports.stands and self.set_point.speed_mps == 0.0:
            return -1.0
        return mapping.acceleration_to_pedal(self.reports.acceleration_mps2(), self._similarity)

    def _steering(self) -> float:
        motion = self.reports.motion
        inner_rad = motion.inner_steering_rad if motion else 0.0
        return steering_of(inner_rad, self._spec, self._similarity)


def _sent(frame: frames.Frame, message: object) -> Sent:
    return Sent(frame, frames.encode(frame, message))
