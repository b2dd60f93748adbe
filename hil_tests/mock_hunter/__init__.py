"""``python -m hil_tests mock_hunter``: a simulated Hunter on a CAN bus, with faults to switch on.

`MockHunter` has no clock: frames and time in, frames out. `serve` runs it on a bus. CONTROL is the
table of who drives, BITS of the errors that stop it, FAULTS of the faults. The manual does not say
who has control after the remote control or the emergency stop is released: here control goes back
to where it was, which is the worst case.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import queue
import signal
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import NamedTuple

import can

from edge_runtime.cli import examples
from edge_runtime.vehicles.hunter import MULTICAST_BUS, open_bus, parse_bus, protocol
from edge_runtime.vehicles.hunter.protocol import Sent, WheelMotion
from edge_runtime.vehicles.mapping import clamp


class Bit(NamedTuple):
    """An error that the chassis shows in 0x211, by the driver's words for it.

    ``stops``: it stops the vehicle; ``latches``: it stays until 0x441. Both are assumptions.
    """

    words: str
    stops: bool = True
    latches: bool = False


BITS: dict[str, Bit] = {
    "steering_encoder": Bit(protocol.STEER_ENCODER, latches=True),
    "driver": Bit(protocol.DRIVER, latches=True),
    "undervoltage": Bit(protocol.UNDERVOLTAGE),
    "link_steer": Bit(protocol.LINK_STEER),
    "link_rear_right": Bit(protocol.LINK_REAR_RIGHT),
    "link_rear_left": Bit(protocol.LINK_REAR_LEFT),
    "overtemperature": Bit(protocol.OVERTEMPERATURE),
    "overcurrent": Bit(protocol.OVERCURRENT, latches=True),
    "remote_lost": Bit(protocol.REMOTE_LOST, stops=False),
}
FAULTS: dict[str, str] = {
    "silent": "it sends nothing, and obeys",
    "frozen": "it repeats its last frames, and obeys",
    "stuck": "its motors stay as they are, whatever is asked; its brake works",
    "full_lock": "its wheels go to full lock, whatever is asked",
    "lying": "it reports an impossible speed",
    "late": "all its frames come late",
    "bus_off": "it neither sends nor receives",
    "remote": "the remote control takes over, its sticks at rest",
    "estop": "its emergency stop is pressed",
    **{name: bit.words for name, bit in BITS.items()},
}
LATE_S = 0.4
LIE_MPS = 3.0


class Control(StrEnum):
    """Who drives. ``*_OVER_CAN``: the bus had control, and gets it back afterwards."""

    STANDBY = "standby"
    CAN = "can"
    LINK_LOST = "link_lost"  # standby, because commands stopped coming
    REMOTE = "remote"
    REMOTE_OVER_CAN = "remote_over_can"


_S, _C, _L, _R, _O = Control
CONTROL: dict[str, tuple[Control, ...]] = {
    # in:         standby, can, link_lost, remote, remote_over_can
    "0x421 = 1":         (_C, _C, _C, _R, _O),  # the remote control always outranks the bus
    "0x421 = 0":         (_S, _S, _S, _R, _R),
    "0x111":             (_S, _C, _C, _R, _O),  # the trap: from link_lost to can, unasked
    "time-out":          (_S, _L, _L, _R, _O),
    "remote takes over": (_R, _O, _O, _R, _O),
    "remote lets go":    (_S, _C, _L, _S, _C),
}  # fmt: skip
"""Event -> the state after it, for each state before it in the order of `Control`."""

STANDS_MPS = 0.005
"""Slower than this it stands; half a count of 0x221 is 0.0005."""
FAST_S = 0.02
SLOW_EVERY = 5  # The 100 ms frames go with every fifth of the 20 ms frames
STEP_S = 0.005
REST = WheelMotion(0.0, 0.0)
_LONGEST_GAP_S = 10.0  # In a longer pause of the process it comes to rest
_BATTERY_V = 27.9
# The motors report a stand and no fault, whatever 0x211 and 0x221 show.
_MOTOR_FAST = protocol.MotorFast(speed_rpm=0, current_a=1.0, pulses=0)
_MOTOR_SLOW = protocol.MotorSlow(_BATTERY_V, driver_c=35, motor_c=35, status=1 << 6)
_FAULT_BITS = {words: mask for mask, words in protocol.PROFILES["v2"].items()}


@dataclass(frozen=True)
class Parameters:
    """Limits and actuators of one model. Angles are those of the inner front wheel."""

    # From AgileX's user manual:
    max_speed_mps: float
    max_inner_rad: float
    command_timeout_s: float = 0.5
    # Assumed, because the manual does not describe the actuators: measure them.
    dead_time_s: float = 0.03  # From a command on the bus to the first movement of an actuator
    speed_time_constant_s: float = 0.1
    acceleration_mps2: float = 2.0
    braking_mps2: float = 3.0
    """Deceleration by the speed controller, and by the brake."""
    steering_rate_radps: float = 1.0


MODELS: dict[str, Parameters] = {
    "hunter-2.0": Parameters(1.5, 0.576),
    "hunter-se": Parameters(4.8, 0.400, acceleration_mps2=3.0, braking_mps2=4.0),
}


class MockHunter:
    """A chassis that was just switched on: standby, brake locked, no error. Not thread-safe.

    Call `receive` for each frame of the bus, and `due` at `next_s`. Left is positive.
    """

    def __init__(self, parameters: Parameters, now_s: float) -> None:
        self.control, self.brake_locked, self.faults = Control.STANDBY, True, set[str]()
        self.errors: set[str] = set()  # of BITS, as it shows them
        self.speed_mps = self.inner_rad = 0.0
        self.sticks = REST  # of the remote control: the person's request
        self.next_s = now_s
        self._parameters, self._now_s = parameters, now_s
        self._commanded_s = -math.inf  # when the newest 0x111 came, or CAN control was taken
        self._under_way: deque[tuple[float, WheelMotion]] = deque()
        self._setpoint = WheelMotion(0.0, 0.0)
        self._tick = 0
        self._fast: list[Sent] = []
        self._slow: list[Sent] = []
        self._outgoing: deque[tuple[float, Sent]] = deque()

    @property
    def stands(self) -> bool:
        return abs(self.speed_mps) < STANDS_MPS

    @property
    def state(self) -> int:
        if "estop" in self.faults:
            return protocol.STATE_ESTOP
        is_stopped = any(BITS[error].stops for error in self.errors)
        return protocol.STATE_EXCEPTION if is_stopped else protocol.STATE_OK

    @property
    def obeys(self) -> bool:
        """Whether the body follows the set-point of the bus."""
        may_drive = self.state == protocol.STATE_OK and not self.brake_locked
        return self.control is Control.CAN and may_drive

    def describe(self) -> str:
        """Describe the discrete state in a line, which changes only with that."""
        return (
            f"control={self.control} state={self.state}"
            f" brake={'locked' if self.brake_locked else 'released'}"
            f" motion={'stands' if self.stands else 'moves'}"
            f" errors={','.join(sorted(self.errors)) or 'none'}"
        )

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take a frame of the bus; ignore unknown ones, and those of a wrong length."""
        self.advance(now_s)
        message = protocol.decode(can_id, data)
        if message is None or "bus_off" in self.faults:
            return
        if can_id == protocol.MOTION_COMMAND.can_id:
            if "full_lock" in self.faults:
                message = message._replace(inner_steering_rad=-self._parameters.max_inner_rad)
            self._change_control("0x111")
            self._commanded_s = now_s
            self._under_way.append((now_s + self._parameters.dead_time_s, message))
        elif can_id == protocol.MODE_COMMAND.can_id and message.value in (0, 1):
            before = self.control
            self._change_control(f"0x421 = {message.value}")
            if self.control is Control.CAN and before is not Control.CAN:
                self._commanded_s = now_s  # the time-out counts from here
        elif can_id == protocol.BRAKE_COMMAND.can_id and message.value in (0, 1):
            self.brake_locked = message.value == protocol.LOCK
        elif can_id == protocol.CLEAR_COMMAND.can_id:
            self.errors &= self.faults

    def switch(self, name: str, on: bool, now_s: float) -> None:
        """Switch a fault. An error that does not latch ends with its cause."""
        self.advance(now_s)
        (self.faults.add if on else self.faults.discard)(name)
        if name in BITS and on:
            self.errors.add(name)
        elif name in BITS and not BITS[name].latches:
            self.errors.discard(name)
        elif name == "remote":
            self._change_control("remote takes over" if on else "remote lets go")

    def due(self, now_s: float) -> list[Sent]:
        """Return the frames to send now; after a pause one report, not one per missed period."""
        self.advance(now_s)
        if now_s >= self.next_s:
            self._report(now_s)
            self._tick += 1
            missed = int((now_s - self.next_s) / FAST_S)
            self.next_s += (missed + 1) * FAST_S
        frames = []
        while self._outgoing and self._outgoing[0][0] <= now_s:
            frames.append(self._outgoing.popleft()[1])
        return frames

    def advance(self, now_s: float) -> None:
        self._now_s = max(self._now_s, now_s - _LONGEST_GAP_S)
        while now_s - self._now_s > 1e-9:
            step_s = min(STEP_S, now_s - self._now_s)
            self._now_s += step_s
            if self._now_s - self._commanded_s > self._parameters.command_timeout_s:
                self._change_control("time-out")
            while self._under_way and self._under_way[0][0] <= self._now_s:
                self._setpoint = self._under_way.popleft()[1]
            self._move(step_s)

    def _change_control(self, event: str) -> None:
        self.control = CONTROL[event][list(Control).index(self.control)]

    def _move(self, step_s: float) -> None:
        """Integrate one step towards the set-point, or brake with the steering held."""
        p = self._parameters
        remote = self.control in (Control.REMOTE, Control.REMOTE_OVER_CAN)
        if in_hand := remote and self.state == protocol.STATE_OK and self.sticks != REST:
            self._setpoint = self.sticks
        if not (in_hand or self.obeys):
            # If control comes back, it begins at a stand, not with the last set-point.
            self._setpoint = WheelMotion(0.0, self.inner_rad)
            self.speed_mps -= clamp(self.speed_mps, p.braking_mps2 * step_s)
        elif "stuck" not in self.faults:
            gap_mps = clamp(self._setpoint.speed_mps, p.max_speed_mps) - self.speed_mps
            change_mps = gap_mps * (1 - math.exp(-step_s / p.speed_time_constant_s))
            brakes = self.speed_mps * change_mps < 0
            rate_mps2 = p.braking_mps2 if brakes else p.acceleration_mps2
            self.speed_mps += clamp(change_mps, rate_mps2 * step_s)
            turn_rad = clamp(self._setpoint.inner_steering_rad, p.max_inner_rad) - self.inner_rad
            self.inner_rad += clamp(turn_rad, p.steering_rate_radps * step_s)

    def _report(self, now_s: float) -> None:
        with_slow = self._tick % SLOW_EVERY == 0
        if "frozen" not in self.faults or not self._slow:
            speed_mps = self.speed_mps + (LIE_MPS if "lying" in self.faults else 0.0)
            motion = protocol.MOTION_STATUS.sent(WheelMotion(speed_mps, self.inner_rad))
            self._fast = [motion, *(row.sent(_MOTOR_FAST) for row in protocol.MOTORS_FAST)]
            self._slow = self._slow_frames() if with_slow else self._slow
        if self.faults & {"silent", "bus_off"}:
            return
        release_s = now_s + (LATE_S if "late" in self.faults else 0.0)
        if self._outgoing:
            release_s = max(release_s, self._outgoing[-1][0])  # a bus keeps their order
        frames = self._fast + (self._slow if with_slow else [])
        self._outgoing.extend((release_s, frame) for frame in frames)

    def _slow_frames(self) -> list[Sent]:
        """Make 0x211 and 0x261 to 0x263: every 100 ms."""
        words = [BITS[error].words for error in self.errors]
        words += [protocol.LINK_LOST] if self.control is Control.LINK_LOST else []
        mode = protocol.CAN_CONTROL if self.control is Control.CAN else protocol.STANDBY
        if self.control in (Control.REMOTE, Control.REMOTE_OVER_CAN):
            mode = protocol.REMOTE_CONTROL
        faults, counter = sum(_FAULT_BITS[each] for each in words), self._tick // SLOW_EVERY % 256
        status = (self.state, mode, _BATTERY_V, faults, int(self.brake_locked), counter)
        motors = [row.sent(_MOTOR_SLOW) for row in protocol.MOTORS_SLOW]
        return [protocol.SYSTEM_STATUS.sent(status), *motors]


EXAMPLE = examples(
    "python -m hil_tests mock_hunter",
    "python -m hil_tests mock_hunter --bus socketcan:vcan0",
)
_tell = partial(print, flush=True)
Orders = queue.SimpleQueue[tuple[str, bool | WheelMotion]]
"""A fault's name, and whether it is switched on; or STICKS, and their position."""
STICKS = "sticks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        f"{parser.description} "
        "Faults are switched while it runs by lines on its standard input: NAME on, NAME off."
        f" Names are {', '.join(FAULTS)}. `{STICKS} MPS RAD` is the request of a person with the"
        " remote control while that has taken over (RAD: of the inner wheel, above 0 to the left)."
    )
    add = parser.add_argument
    add("--bus", default=MULTICAST_BUS, metavar="INTERFACE:CHANNEL", help="CAN bus to join")
    add("--model", default="hunter-2.0", choices=list(MODELS), help="model of the Hunter")


def run(arguments: argparse.Namespace) -> int:
    ending, orders = threading.Event(), Orders()
    with open_bus(parse_bus(arguments.bus)) as bus:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: ending.set())
        threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
        _tell(f"ready bus={arguments.bus} model={arguments.model}")
        serve(MockHunter(MODELS[arguments.model], time.monotonic()), bus, orders, ending)
    return 0


def serve(hunter: MockHunter, bus: can.BusABC, orders: Orders, ending: threading.Event) -> None:
    """Run a mock on a bus; print every change as one line with its time (monotonic)."""
    printed = ""
    while not ending.is_set():
        while not orders.empty():
            (name, on), now_s = orders.get(), time.monotonic()
            if isinstance(on, WheelMotion):
                hunter.sticks = on
                continue
            hunter.switch(name, on, now_s)
            _tell(f"fault t={now_s:.6f} {name}={'on' if on else 'off'}")
        for row, data in hunter.due(time.monotonic()):
            message = can.Message(arbitration_id=row.can_id, data=data, is_extended_id=False)
            with contextlib.suppress(can.CanError):  # the driver notices
                bus.send(message)
        if (words := hunter.describe()) != printed:
            printed = words
            _tell(f"chassis t={time.monotonic():.6f} {words}")
        with contextlib.suppress(can.CanError):  # data that is no frame
            frame = bus.recv(max(0.0, hunter.next_s - time.monotonic()))
            if frame is None or frame.is_extended_id or frame.is_remote_frame or frame.is_fd:
                continue  # the chassis has data frames with an 11-bit identifier only
            if not frame.is_error_frame:
                hunter.receive(frame.arbitration_id, bytes(frame.data), time.monotonic())


def _read_orders(orders: Orders) -> None:
    with open(0, errors="replace", closefd=False) as lines:
        for line in lines:
            name, _, word = line.strip().partition(" ")
            if name == STICKS:
                with contextlib.suppress(ValueError, TypeError):
                    orders.put((name, WheelMotion(*map(float, word.split()))))
                    continue
            if name in FAULTS and word in ("on", "off"):
                orders.put((name, word == "on"))
            else:
                message = f"error: {line.strip()!r} is no order: use NAME on, or NAME off"
                print(message, file=sys.stderr, flush=True)
