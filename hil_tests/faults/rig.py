"""A drive to be disturbed: edge runtime, simulator and, where a row asks, a link or a router.

    [chassis process --] edge process -- [link | router process --] probe -- simulator process

The simulator may also be the rig's own sender, where a row sends states of its own.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edge_runtime.commands import ask
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError
from hil_tests.faults.can_ears import CanEars
from hil_tests.faults.chassis import ChassisProcess, free_bus
from hil_tests.faults.endless import BRAKES, BRIGHT, DIRECTORY, END, ENVIRONMENT
from hil_tests.faults.link import Link
from hil_tests.faults.probe import Probe
from hil_tests.faults.processes import Process, wait_until
from hil_tests.faults.sender import Sender
from hil_tests.faults.timeline import BrakeSeen, ModeSeen, Timeline, last_drive_s

VEHICLE_ID = "faults"
EARS = (0x111, 0x131, 0x421, 0x441, 0x211, 0x221)
"""What is kept of the CAN bus: all commands, the chassis's state, its speed."""
_MODE = re.compile(r"\bmode\b.*\bnow\W+(\w+)(?:.*\breason\W+(\w+))?")
_SETTLED_S, _SETTLED_COMMANDS = 0.35, 3
_REARM_EVERY_S = 2.0


class Rig:
    """Start it with ``with``; it ends every process that it started."""

    def __init__(
        self,
        policy: Sequence[str],
        directory: Path,
        between: str = "",
        vehicle: str = "none",
        sender: bool = False,
        model: str = "",
    ) -> None:
        self.timeline = Timeline()
        self.directory = directory
        self.crashes: list[str] = []
        self._policy, self._vehicle = policy, vehicle
        self._processes: list[tuple[str, Process]] = []
        (directory / BRAKES).touch()
        self._simulator_endpoint, self._hub = free_endpoint(), free_endpoint()
        self.simulator = None if sender else self.start_simulator()
        connect = None if sender else self._simulator_endpoint
        self.probe = Probe(self._hub, connect, VEHICLE_ID, self.timeline)
        self.sender = Sender(self.probe) if sender else None
        self.link = Link(self._hub) if between == "link" else None
        self.router_endpoint = free_endpoint() if between == "router" else ""
        self.router = self.start_router() if self.router_endpoint else None
        self._bus = free_bus() if model else ""
        self.chassis = ChassisProcess(self._bus, "--model", model) if model else None
        self.ears = CanEars(self._bus, EARS) if model else None
        if self.chassis is not None:
            self._processes.append(("chassis", self.chassis.process))
        self.edge = self.start_edge()

    def start_edge(self) -> Process:
        """The edge runtime, not waited for."""
        endpoint = self.link.endpoint if self.link else self.router_endpoint or self._hub
        arguments = ["edge_runtime", "run", *self._policy, "--connect", endpoint]
        arguments += ["--vehicle-id", VEHICLE_ID, "--vehicle", self._vehicle]
        if self._bus:
            arguments += ["--bus", self._bus]
        return self._start("edge", "hil_tests.faults.launch", *arguments)

    def start_simulator(self) -> Process:
        """`bridge simulate` in real time, not waited for."""
        arguments = ["bridge", "simulate", "--env", ENVIRONMENT, "--clock", "realtime"]
        arguments += ["--listen", self._simulator_endpoint, "--vehicle-id", VEHICLE_ID]
        arguments += ["--out", str(self.directory / "report.json")]
        return self._start("simulator", "hil_tests.faults.launch", *arguments)

    def start_recorder(self, path: Path) -> Process:
        """`bridge record` of this drive, not waited for."""
        arguments = ["bridge", "record", "--out", str(path), "--connect", self._hub]
        return self._start("recorder", *arguments, "--vehicle-id", VEHICLE_ID)

    def start_router(self) -> Process:
        """The router process between edge and probe, not waited for."""
        return self._start("router", "hil_tests.faults.router", self.router_endpoint, self._hub)

    def wait_until_driving(
        self, timeout_s: float = 30.0, ready: Callable[[], bool] = lambda: True
    ) -> None:
        """Until drive commands come steadily, the simulated vehicle's brake is off, and ``ready``.

        A vehicle is re-armed until then.
        """
        rearmed_s = time.monotonic()

        def driving() -> bool:
            nonlocal rearmed_s
            if self._vehicle != "none" and time.monotonic() - rearmed_s > _REARM_EVERY_S:
                # A busy machine may have stopped it once more: the operator stays beside it.
                self._ask_to_rearm()
                rearmed_s = time.monotonic()
            return self._is_driving() and ready()

        wait_until(driving, "a steady drive", timeout_s)

    def mark(self) -> float:
        """Now, the moment before a fault."""
        return time.monotonic()

    def brakes(self) -> list[BrakeSeen]:
        """What the simulated vehicle's brake did so far."""
        lines = (self.directory / BRAKES).read_text().splitlines()
        return [BrakeSeen(float(a), b == "1") for a, b in (line.split() for line in lines)]

    def switch(self, name: str, word: str | None) -> None:
        """Write a word into one of the files that the faulty ends look at; None removes it."""
        path = self.directory / name
        if word is None:
            path.unlink(missing_ok=True)
            return
        temporary = path.with_suffix(".new")
        temporary.write_text(word)
        temporary.replace(path)

    def rearm(self) -> None:
        """As an operator does, once the runtime takes it."""
        wait_until(self._ask_to_rearm, "the vehicle to be re-armed")

    def try_rearm(self) -> bool:
        """Ask once; whether the runtime took it."""
        return self._ask_to_rearm()

    def bright(self, on: bool) -> None:
        """Turn the frames white, or back."""
        self.switch(BRIGHT, "" if on else None)

    def end_drive(self) -> None:
        """Let the simulator end its episode and write its report."""
        assert self.simulator is not None
        self.switch(END, "")
        self.simulator.wait()

    def close(self) -> None:
        """End everything; crashes are noted first."""
        if self.sender is not None:
            self.sender.stop()
        for name, process in self._processes:
            if process.crashed():
                self.crashes.append(f"{name}: {process.lines[-1:]}")
        # The simulator first: it says its episode's end to an edge that still listens.
        for _, process in reversed(self._processes):
            process.end()
        if self.link is not None:
            self.link.close()
        if self.ears is not None:
            self.ears.close()
        self.probe.close()

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _ask_to_rearm(self) -> bool:
        with contextlib.suppress(UserError):  # on a starved machine an answer may take too long
            return bool(ask(self._hub, VEHICLE_ID, "rearm")["accepted"])
        return False

    def _is_driving(self) -> bool:
        now_s = time.monotonic()
        recent = [c for c in self.timeline.commands[-10:] if now_s - c.seen_s < _SETTLED_S]
        steady = len(recent) >= _SETTLED_COMMANDS and {c.mode for c in recent} == {"drive"}
        brakes = self.brakes()
        fresh = now_s - last_drive_s(self.timeline) < _SETTLED_S
        return steady and fresh and not (brakes and brakes[-1].pressed)

    def _start(self, name: str, *arguments: str) -> Process:
        on_line = self._on_edge_line if name == "edge" else lambda seen_s, line: None
        process = Process(*arguments, environment={DIRECTORY: str(self.directory)}, on_line=on_line)
        self._processes.append((name, process))
        return process

    def _on_edge_line(self, seen_s: float, line: str) -> None:
        found = _MODE.search(line)
        if found:
            mode, reason = found.group(1), found.group(2) or ""
            self.timeline.modes.append(ModeSeen(seen_s, mode, reason))
