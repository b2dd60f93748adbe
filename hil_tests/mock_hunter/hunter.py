"""The whole mock: frames and time in, frames out. No clock and no bus of its own.

Parameters and actuators with a lag and a rate come first, then the mock made of them and of the
chassis's rules. Drive it with `receive` for each frame of the bus and `due` at `next_s`; both take
the time. Angles are positive to the left. The inner front wheel is the one on the side of the turn.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import protocol as codec
from edge_runtime.vehicles.hunter.protocol import LINK_LOST, MotionCommand, Sent, fault_bits
from edge_runtime.vehicles.mapping import clamp
from hil_tests.mock_hunter import chassis as rules
from hil_tests.mock_hunter.chassis import (
    BITS,
    LATE_S,
    LIE_MPS,
    STEERING,
    Chassis,
    ChassisCondition,
    ChassisEvent,
    Control,
)

STANDS_MPS = 0.005
"""Slower than this it stands: half of what one count in 0x221 could show is 0.0005."""
FAST_S = 0.02
SLOW_EVERY = 5  # Frames of 100 ms go with every fifth of those of 20 ms
STEP_S = 0.005
_LONGEST_GAP_S = 10.0  # After a longer pause of the process it has long come to its rest
_MODES = {
    Control.STANDBY: codec.STANDBY,
    Control.CAN: codec.CAN_CONTROL,
    Control.LINK_LOST: codec.STANDBY,
    Control.REMOTE: codec.REMOTE_CONTROL,
    Control.REMOTE_OVER_CAN: codec.REMOTE_CONTROL,
}
_STATES = {
    ChassisCondition.OK: codec.STATE_OK,
    ChassisCondition.ESTOP: codec.STATE_ESTOP,
    ChassisCondition.EXCEPTION: codec.STATE_EXCEPTION,
    ChassisCondition.ESTOP_AND_EXCEPTION: codec.STATE_ESTOP,
}
_OF_A_PERSON = {
    "remote": (ChassisEvent.REMOTE_ON, ChassisEvent.REMOTE_OFF),
    "estop": (ChassisEvent.ESTOP_ON, ChassisEvent.ESTOP_OFF),
}
_SLOW = (codec.STEER_MOTOR_SLOW, codec.REAR_RIGHT_SLOW, codec.REAR_LEFT_SLOW)
_ENABLED = 1 << 6
_COOL_C, _HOT_C = 35, 105
_BATTERY_V, _LOW_V, _IDLE_A = 27.9, 21.0, 1.0
_INT32 = 2**32


@dataclass(frozen=True)
class Parameters:
    """Geometry and actuators of one model."""

    # From AgileX's user manual:
    max_speed_mps: float
    max_inner_rad: float  # Of the inner front wheel
    wheelbase_m: float
    track_m: float
    command_timeout_s: float = 0.5
    # Assumed, since the manual says nothing of the actuators: measure them, and pass them by --set.
    dead_time_s: float = 0.03  # From a command on the bus to the first movement of an actuator
    speed_time_constant_s: float = 0.1
    acceleration_mps2: float = 2.0
    braking_mps2: float = 3.0
    """Of the speed controller, and of the brake: the chassis stops a moving car with either."""
    steering_rate_radps: float = 1.0  # Of the inner wheel
    motor_revolutions_per_m: float = 20.0  # Of path of a rear wheel
    steer_revolutions_per_rad: float = 20.0
    """Of the steering motor, for each radian of the inner wheel."""
    pulses_per_revolution: float = 100.0  # Of a motor's encoder


MODELS: dict[str, Parameters] = {
    "hunter-2.0": Parameters(
        max_speed_mps=1.5, max_inner_rad=0.576, wheelbase_m=0.650, track_m=0.605
    ),
    # The SE's manual leaves its track between 0.46 and 0.52 m: the middle is assumed.
    "hunter-se": Parameters(
        max_speed_mps=4.8, max_inner_rad=0.400, wheelbase_m=0.55, track_m=0.49,
        acceleration_mps2=3.0, braking_mps2=4.0,
    ),
}  # fmt: skip

TUNABLE = [field.name for field in fields(Parameters)]


def make_parameters(model: str, changes: Mapping[str, float]) -> Parameters:
    """Return a model's row with some numbers replaced. Raises UserError for bad numbers."""
    for name, value in changes.items():
        if name not in TUNABLE:
            raise UserError(f"no parameter {name!r}; choose from {', '.join(TUNABLE)}")
        may_be_zero = name == "dead_time_s"
        if not (0.0 < value < math.inf or (may_be_zero and value == 0.0)):
            least = "at least" if may_be_zero else "above"
            raise UserError(f"parameter {name} must be {least} 0 and finite, not {value}")
    return replace(MODELS[model], **changes)


class Body(NamedTuple):
    """Its speed, its inner wheel's angle and the rate of that, and the way of each rear wheel."""

    speed_mps: float = 0.0
    inner_rad: float = 0.0
    steering_radps: float = 0.0
    right_m: float = 0.0
    left_m: float = 0.0

    @property
    def stands(self) -> bool:
        return abs(self.speed_mps) < STANDS_MPS


def advance(
    body: Body, setpoint: MotionCommand | None, step_s: float, parameters: Parameters
) -> Body:
    """Integrate one step towards the set-point; None: brake, with the steering held."""
    p, inner_rad = parameters, body.inner_rad
    if setpoint is None:
        change_mps, rate_mps2 = -body.speed_mps, p.braking_mps2
    else:
        gap_mps = clamp(setpoint.speed_mps, p.max_speed_mps) - body.speed_mps
        change_mps = gap_mps * (1 - math.exp(-step_s / p.speed_time_constant_s))
        rate_mps2 = p.braking_mps2 if body.speed_mps * change_mps < 0 else p.acceleration_mps2
        turn_rad = clamp(setpoint.inner_steering_rad, p.max_inner_rad) - body.inner_rad
        inner_rad += clamp(turn_rad, p.steering_rate_radps * step_s)
    speed_mps = body.speed_mps + clamp(change_mps, rate_mps2 * step_s)
    steering_radps = (inner_rad - body.inner_rad) / step_s
    after = body._replace(speed_mps=speed_mps, inner_rad=inner_rad, steering_radps=steering_radps)
    return roll(after, step_s, parameters)


def roll(body: Body, step_s: float, parameters: Parameters) -> Body:
    """Roll at the present speed; in a turn the outer rear wheel covers more."""
    half = curvature(body.inner_rad, parameters) * parameters.track_m / 2
    way_m = body.speed_mps * step_s
    return body._replace(
        right_m=body.right_m + way_m * (1 + half), left_m=body.left_m + way_m * (1 - half)
    )


def curvature(inner_rad: float, parameters: Parameters) -> float:
    """Return the curvature of the rear axle's middle, 1/m, for an inner wheel's angle (Ackermann).

    radius = wheelbase / tan(inner) + track / 2
    """
    slope = math.tan(abs(inner_rad))
    amount = slope / (parameters.wheelbase_m + slope * parameters.track_m / 2)
    return math.copysign(amount, inner_rad)


class MockHunter:
    """A chassis that was just switched on. Not thread-safe."""

    def __init__(self, parameters: Parameters, now_s: float, profile: str = "v2") -> None:
        self.chassis = Chassis()
        self.body = Body()
        self.faults: set[str] = set()
        self.next_s = now_s  # When `due` must be called next
        self._parameters, self._profile = parameters, profile
        self._now_s = now_s
        self._under_way: deque[tuple[float, MotionCommand]] = deque()
        self._setpoint = MotionCommand(0.0, 0.0)
        self._tick = 0
        self._fast: list[Sent] = []
        self._slow: list[Sent] = []
        self._outgoing: deque[tuple[float, Sent]] = deque()

    def describe(self) -> str:
        """Describe its state in a line that only changes when something happens."""
        return (
            f"control={self.chassis.control.value} condition={self.chassis.condition.value}"
            f" brake={'locked' if self.chassis.brake_locked else 'released'}"
            f" motion={'stands' if self.body.stands else 'moves'}"
            f" errors={','.join(sorted(self.chassis.errors)) or 'none'}"
        )

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take a frame of the bus; ignore unknown ones, and those of a wrong length."""
        self.advance(now_s)
        message = codec.decode(can_id, data)
        if message is None or "bus_off" in self.faults:
            return
        if isinstance(message, MotionCommand):
            right_rad = -self._parameters.max_inner_rad
            inner_rad = right_rad if "full_lock" in self.faults else message.inner_steering_rad
            asked = MotionCommand(message.speed_mps, inner_rad)
            self.chassis = rules.take_command(self.chassis, now_s)
            self._under_way.append((now_s + self._parameters.dead_time_s, asked))
        elif isinstance(message, codec.ModeCommand):
            if message.mode == codec.CAN_CONTROL:
                self.chassis = rules.take_can_mode(self.chassis, now_s)
            elif message.mode == codec.STANDBY:
                self.chassis = rules.advance(self.chassis, ChassisEvent.STANDBY_MODE)
        elif isinstance(message, codec.BrakeCommand) and message.locked in (0, 1):
            self.chassis = self.chassis._replace(brake_locked=message.locked == 1)
        elif isinstance(message, codec.ClearCommand):
            self.chassis = rules.take_clear(self.chassis)

    def switch(self, name: str, on: bool, now_s: float) -> None:
        self.advance(now_s)
        (self.faults.add if on else self.faults.discard)(name)
        if name in BITS:
            self.chassis = rules.take_cause(self.chassis, name, on)
        elif name in _OF_A_PERSON:
            event = _OF_A_PERSON[name][0 if on else 1]
            self.chassis = rules.advance(self.chassis, event)

    def due(self, now_s: float) -> list[Sent]:
        """Return the frames to send now; after a pause one report, not one a missed period."""
        self.advance(now_s)
        if now_s >= self.next_s:
            self._report(now_s)
            self._tick += 1
            missed = int((now_s - self.next_s) / FAST_S)
            self.next_s += (missed + 1) * FAST_S
        found = []
        while self._outgoing and self._outgoing[0][0] <= now_s:
            found.append(self._outgoing.popleft()[1])
        return found

    def advance(self, now_s: float) -> None:
        p = self._parameters
        self._now_s = max(self._now_s, now_s - _LONGEST_GAP_S)
        while now_s - self._now_s > 1e-9:
            step_s = min(STEP_S, now_s - self._now_s)
            self._now_s += step_s
            self.chassis = rules.take_time(self.chassis, self._now_s, p.command_timeout_s)
            while self._under_way and self._under_way[0][0] <= self._now_s:
                self._setpoint = self._under_way.popleft()[1]
            if not rules.obeys(self.chassis):
                # Where control comes back, it does so from a stand, not with what was asked before.
                self._setpoint = MotionCommand(0.0, self.body.inner_rad)
                self.body = advance(self.body, None, step_s, p)
            elif "stuck" in self.faults:
                self.body = roll(self.body, step_s, p)
            else:
                self.body = advance(self.body, self._setpoint, step_s, p)

    def _report(self, now_s: float) -> None:
        with_slow = self._tick % SLOW_EVERY == 0
        if "frozen" not in self.faults or not self._slow:
            self._fast = self._fast_frames()
            self._slow = self._slow_frames() if with_slow else self._slow
        if self.faults & {"silent", "bus_off"}:
            return
        release_s = now_s + (LATE_S if "late" in self.faults else 0.0)
        if self._outgoing:
            release_s = max(release_s, self._outgoing[-1][0])  # a bus keeps their order
        frames = self._fast + (self._slow if with_slow else [])
        self._outgoing.extend((release_s, frame) for frame in frames)

    def _fast_frames(self) -> list[Sent]:
        """Make 0x221 and 0x251 to 0x253: every 20 ms."""
        body, p = self.body, self._parameters
        speed_mps = body.speed_mps + (LIE_MPS if "lying" in self.faults else 0.0)
        found = [codec.MOTION_STATUS.sent(codec.MotionStatus(speed_mps, body.inner_rad))]
        half = curvature(body.inner_rad, p) * p.track_m / 2
        drive, steer = p.motor_revolutions_per_m, p.steer_revolutions_per_rad
        for row, turns, speed, way in (
            (codec.REAR_RIGHT_FAST, drive, body.speed_mps * (1 + half), body.right_m),
            (codec.REAR_LEFT_FAST, drive, body.speed_mps * (1 - half), body.left_m),
            (codec.STEER_MOTOR_FAST, steer, body.steering_radps, body.inner_rad),
        ):
            # As a 32-bit counter shows it after it has run over.
            pulses = round(way * turns * p.pulses_per_revolution)
            shown = (pulses + _INT32 // 2) % _INT32 - _INT32 // 2
            found.append(row.sent(codec.MotorFast(round(speed * turns * 60), _IDLE_A, shown)))
        return found

    def _slow_frames(self) -> list[Sent]:
        """Make 0x211 and 0x261 to 0x263: every 100 ms."""
        chassis, errors = self.chassis, self.chassis.errors
        words = [BITS[error].words for error in errors]
        words += [LINK_LOST] if chassis.control is Control.LINK_LOST else []
        volts = _LOW_V if "undervoltage" in errors else _BATTERY_V
        status = codec.SystemStatus(
            state=_STATES[chassis.condition],
            mode=_MODES[chassis.control],
            battery_v=volts,
            faults=sum(fault_bits(each, self._profile) for each in words),
            brake=int(chassis.brake_locked),
            counter=self._tick // SLOW_EVERY % 256,
        )
        found = [codec.SYSTEM_STATUS.sent(status)]
        for motor, row in enumerate(_SLOW):
            shown = (BITS[error].motor_bits for error in errors if motor in BITS[error].motors)
            hot = "overtemperature" in errors and motor != STEERING
            celsius = _HOT_C if hot else _COOL_C
            slow = codec.MotorSlow(volts, celsius, celsius, _ENABLED | sum(shown))
            found.append(row.sent(slow))
        return found
