"""The mock Hunter as a process beside a rig: its switches, and what it says it really did."""

from __future__ import annotations

import re
import socket
from typing import NamedTuple

from edge_runtime.vehicles.hunter import bus as multicast
from hil_tests.faults.processes import Process, wait_until

_TOLD = re.compile(r"chassis t=([\d.]+) control=(\w+) condition=(\w+).* motion=(\w+)")
_SWITCHED = re.compile(r"fault t=([\d.]+) (\w+)=(\w+)")


class Truth(NamedTuple):
    """What the mock is and does from this moment (monotonic) on, whatever it reports."""

    since_s: float
    control: str
    condition: str
    moves: bool


def free_bus() -> str:
    """A bus of its own: Linux mixes buses that share a port, whatever their groups."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", 0))
        return f"udp_multicast:{multicast.GROUP}:{one.getsockname()[1]}"


class ChassisProcess:
    """``python -m hil_tests mock_hunter`` on a bus; tell it to `switch` a fault."""

    def __init__(self, bus: str, *arguments: str) -> None:
        self.truth: list[Truth] = []
        self.switched: list[tuple[float, str, str]] = []
        command = ["hil_tests", "mock_hunter", "--bus", bus, *arguments]
        self.process = Process(*command, told=True, on_line=self._on_line)
        self.process.wait_for_line("ready")

    @property
    def moves(self) -> bool:
        """Whether it moves now."""
        return bool(self.truth) and self.truth[-1].moves

    def switch(self, name: str, on: bool) -> float:
        """Switch a fault; when it took effect, monotonic s."""
        count, word = len(self.switched), "on" if on else "off"
        self.process.tell(f"{name} {word}")
        done = wait_until(
            lambda: [s for s in self.switched[count:] if s[1:] == (name, word)],
            f"{name} {word}",
        )
        return float(done[0][0])

    def stands_s(self, since_s: float, timeout_s: float) -> float:
        """When it stood, at or after a moment; TimeoutError where it goes on moving."""
        wait_until(lambda: not self.moves, "the vehicle to stand", timeout_s)
        return max(self.truth[-1].since_s, since_s)

    def moved_between(self, begin_s: float, end_s: float) -> bool:
        """Whether it moved at any moment in between."""
        before = [one for one in self.truth if one.since_s <= begin_s][-1:]
        inside = [one for one in self.truth if begin_s < one.since_s < end_s]
        return any(one.moves for one in before + inside)

    def _on_line(self, seen_s: float, line: str) -> None:
        told, switched = _TOLD.match(line), _SWITCHED.match(line)
        if told:
            moves = told.group(4) == "moves"
            self.truth.append(Truth(float(told.group(1)), told.group(2), told.group(3), moves))
        if switched:
            applied_s, name, word = switched.groups()
            self.switched.append((float(applied_s), name, word))
