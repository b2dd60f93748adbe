"""A driver for a rover that speaks UDP, and (`python -m my_vehicle`) a simulation of that rover.

A command is the datagram `pedal steering seconds`; after these seconds the rover brakes by itself,
so this driver needs no thread. It answers each datagram, also `?`: `speed pedal steering braking`.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from typing import ClassVar

from edge_runtime.controller import ActionLimit
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle, VehicleReport


class Rover(Vehicle):
    """`[vehicle.rover]` holds its address, as HOST:PORT."""

    name = "rover"
    limits: ClassVar = {"pedal": ActionLimit(-1.0, 1.0), "steering": ActionLimit(-1.0, 1.0, 4.0)}

    def __init__(self, address: str = "127.0.0.1:7450") -> None:
        host, _, port = address.rpartition(":")
        self._steering, self._enabled, self._unanswered = 0.0, False, 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._socket.settimeout(1.0)
        try:
            self._socket.send(b"?")
            self._report = self._socket.recv(100)
        except OSError:
            self._socket.close()
            raise UserError(f"no rover answers at {address}: start it, or set address") from None
        self._socket.setblocking(False)

    def enable(self, now_s: float) -> None:
        """Take control; the rover stands until the first command."""
        self._enabled = True

    def command(
        self, action: dict[str, float], now_s: float, scenario_speed_mps: float | None = None
    ) -> None:
        """Drive if enabled; raise ValueError for an invalid command in any case."""
        if "pedal" not in action or not all(map(math.isfinite, action.values())):
            raise ValueError(f"a rover needs a pedal, and finite numbers: {action}")
        if self._enabled:
            pedal, steering = (action.get(name, 0.0) for name in self.limits)
            self._steering = min(max(steering, -1.0), 1.0)
            self._send(min(max(pedal, -1.0), 1.0), 2 * self.control_period_s)

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Brake until `enable`, or (not latched) until the next command."""
        self._enabled = self._enabled and not latch
        self._send(-1.0, 0.0)

    def feedback(self, now_s: float) -> VehicleReport:
        """Report the newest answer; the runtime stops for an exception as for silence."""
        self._socket.send(b"?")
        self._unanswered += 1
        with contextlib.suppress(BlockingIOError):
            while True:
                self._report, self._unanswered = self._socket.recv(100), 0
        if self._unanswered > 4:
            raise TimeoutError("the rover says nothing")
        speed_mps, pedal, steering, braking = map(float, self._report.split())
        return VehicleReport({"pedal": pedal, "steering": steering}, speed_mps, bool(braking), [])

    def close(self) -> None:
        if self._socket.fileno() >= 0:
            with contextlib.suppress(OSError):  # a rover that is gone brakes by itself
                self.brake(0.0)
            self._socket.close()

    def _send(self, pedal: float, seconds: float) -> None:
        self._socket.send(f"{pedal} {self._steering} {seconds}".encode())


def be_a_rover(port: int = 7450) -> None:
    """Simulate the rover: 3 m/s2 at full pedal, 2 m/s at most."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", port))
        speed_mps, pedal, steering, then_s, until_s = 0.0, -1.0, 0.0, time.monotonic(), 0.0
        while True:
            datagram, peer = bound.recvfrom(100)
            now_s = time.monotonic()
            for end_s, held in ((min(until_s, now_s), pedal), (now_s, -1.0)):
                step_s, then_s = max(0.0, end_s - then_s), max(end_s, then_s)
                speed_mps = min(max(speed_mps + 3.0 * held * step_s, 0.0), 2.0)
            if datagram != b"?":
                pedal, steering, seconds = map(float, datagram.split())
                until_s = now_s + seconds
            braking = now_s >= until_s
            answer = f"{speed_mps} {-1.0 if braking else pedal} {steering} {int(braking)}"
            bound.sendto(answer.encode(), peer)


if __name__ == "__main__":
    be_a_rover()
