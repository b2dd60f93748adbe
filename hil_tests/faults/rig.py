"""A drive of real processes, to be disturbed.

    [mock Hunter --] edge runtime --- [relay | router ---] probe --- simulator

For a row with states of its own, the rig sends states in place of the simulator.
"""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np

from edge_runtime.link import ask
from edge_runtime.manifest import Task
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import MULTICAST_GROUP
from edge_runtime.wire import DRIVE, SAFE_STOP, State, encode
from hil_tests.faults import inside
from hil_tests.faults.observe import CanMonitor, CommandSeen, DriveTimeline, Probe, Relay
from hil_tests.faults.policies import VEHICLE_ID
from hil_tests.processes import Process, wait_until

_INSIDE = "hil_tests.faults.inside"
_STOPPED = re.compile(r"\bmode\b.*\bnow\W+safe_stop\b(?:.*\breason\W+(\w+))?")
_TOLD = re.compile(r"chassis t=([\d.]+) .*motion=(\w+)")
_STEADY_PERIODS, _STEADY_COMMANDS = 3.5, 3
_REARM_EVERY_S = 2.0
_HEALTH_S = 0.6  # Longer than a period of the health message


class Rig:
    """Use it in a ``with`` block, which ends every process that it started.

    ``policy`` holds the edge runtime's options for its policy, made for ``task``; ``vehicle`` is
    its ``--vehicle`` (``hunter``: with a mock on a CAN bus), ``settings`` its TOML. Switches and
    reports lie in ``directory``, which is empty at first. ``between`` edge runtime and probe may be
    a ``relay`` or a ``router``. In place of a simulator ``sender`` sends states here, ``senses`` by
    a source of `sense`. The attributes below exist only if the options ask for them.
    """

    simulator: Process
    sender: Sender
    relay: Relay
    router: Process
    chassis: Chassis
    monitor: CanMonitor

    def __init__(
        self,
        policy: Sequence[str],
        directory: Path,
        task: Task,
        between: str = "",
        vehicle: str = "none",
        sender: bool = False,
        senses: bool = False,
        settings: str = "",
    ) -> None:
        self.number = 0  # The number of the try
        self.timeline = DriveTimeline()
        self.crashes: list[str] = []
        self.task, self.period_s = task, task.control_period_s
        self.has_vehicle = vehicle != "none"  # Only an operator lets it drive again after a stop
        self._directory, self._processes = directory, list[Process]()
        self._policy, self._senses = policy, senses
        self._edge = [*policy, "--vehicle-id", VEHICLE_ID, "--vehicle", vehicle]
        (directory / "edge.toml").write_text(settings)
        self._edge += ["--config", str(directory / "edge.toml")]
        (directory / inside.BRAKES).touch()
        (directory / inside.TASK).write_bytes(msgspec.json.encode(task))
        self._listen, self._hub = free_endpoint(), free_endpoint()
        self.edge_endpoint = self._hub
        with contextlib.ExitStack() as self._closing:  # a rig that fails to start leaves nothing
            if not sender:
                self.simulator = self.start_simulator()
            connect = None if sender else self._listen
            self.probe = Probe(self._hub, connect, self.timeline, self._closing)
            if between == "relay":
                self.relay = Relay(self._hub)
                self._closing.callback(self.relay.close)
                self.edge_endpoint = self.relay.endpoint
            if between == "router":
                self.edge_endpoint = free_endpoint()
                self.router = self.start_router()
            if vehicle == "hunter":
                bus = free_bus()
                self._edge += ["--bus", bus]
                self.chassis = Chassis(bus)
                self._keep(self.chassis)
                self.monitor = CanMonitor(bus)
                self._closing.callback(self.monitor.close)
            self.edge = self.start_edge()
            if sender:
                self.sender = Sender(self)
                self._closing.callback(self.sender.stop)
            self._closing = self._closing.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.crashes += [f"{p.name}: {p.lines[-1:]}" for p in self._processes if p.crashed()]
        self._closing.close()

    def start_edge(self) -> Process:
        run = (_INSIDE, "edge_runtime", "run", *self._edge, "--connect", self.edge_endpoint)
        return self._start(*run)

    def start_simulator(self) -> Process:
        where = ("--listen", self._listen, "--vehicle-id", VEHICLE_ID)
        if self._senses:
            sense = ("bridge", "sense", "--source", inside.SENSES, *self._policy)
            return self._start(*sense, *where)
        return self._start(
            _INSIDE, "bridge", "simulate", "--env", inside.ENVIRONMENT, "--clock", "realtime",
            *where, "--out", str(self._directory / "report.json"),
        )  # fmt: skip

    def start_recorder(self) -> tuple[Process, Path]:
        path = self._directory / f"{time.monotonic_ns()}.mcap"  # unique: a try may be repeated
        record = ("bridge", "record", "--out", str(path), "--connect", self._hub)
        return self._start(*record, "--vehicle-id", VEHICLE_ID, ready="recording"), path

    def start_router(self) -> Process:
        ends = ("--listen", self.edge_endpoint, "--connect", self._hub)
        return self._start("bridge", "router", *ends)

    def switch(self, name: str, word: str | None) -> None:
        """Write a word into a switch file of the faulty ends; None removes the file."""
        path = self._directory / name
        path.unlink(missing_ok=True) if word is None else path.write_text(word)

    def try_rearm(self) -> bool:
        with contextlib.suppress(UserError):  # on a starved machine an answer may take too long
            return bool(ask(self._hub, VEHICLE_ID, "rearm")["accepted"])
        return False

    def rearm(self) -> None:
        wait_until(self.try_rearm, "the vehicle to be re-armed")

    def wait_until_driving(self, ready: Callable[[], bool] = lambda: True) -> None:
        """Wait until it drives steadily, its brake off, and is ``ready``; re-arm a vehicle."""
        rearmed_s = time.monotonic()

        def driving() -> bool:
            nonlocal rearmed_s
            if self.has_vehicle and time.monotonic() - rearmed_s > _REARM_EVERY_S:
                # On a busy machine it may have stopped once more.
                self.try_rearm()
                rearmed_s = time.monotonic()
            since_s = time.monotonic() - _STEADY_PERIODS * self.period_s
            recent = [c.mode for c in self.timeline.commands[-10:] if c.seen_s > since_s]
            steady = len(recent) >= _STEADY_COMMANDS and {*recent} == {DRIVE}
            return steady and not any(on for _, on in self.brakes()[-1:]) and ready()

        wait_until(driving, "a steady drive")

    def drive_again(self, ready: Callable[[], bool] = lambda: True) -> float:
        """Re-arm it, wait until it drives steadily; return s until the first drive command."""
        self.rearm()
        rearmed_s = time.monotonic()
        self.wait_until_driving(ready)
        return self.recovered_after_s(rearmed_s)

    def brakes(self) -> list[tuple[float, bool]]:
        """Return when the simulated vehicle's brake was pressed (True) or released so far."""
        lines = (self._directory / inside.BRAKES).read_text().splitlines()
        return [(float(a), b == "1") for a, b in (line.split() for line in lines)]

    def own_brake_s(self, since_s: float) -> float:
        """Wait for the simulated vehicle's own brake after ``since_s``; return when it went on."""
        what = "the simulator's own brake"
        pressed = wait_until(lambda: [s for s, on in self.brakes() if on and s > since_s], what)
        return float(pressed[0])

    def stop_command(self, since_s: float) -> CommandSeen:
        return self._command(lambda c: c.seen_s > since_s and c.mode == SAFE_STOP)

    def recovered_after_s(self, ended_s: float) -> float:
        """Wait for the first drive command sent after the fault's end; return s until it came."""
        # By its sending time: a command that a relay has held is older.
        drive = self._command(lambda c: c.sent_s > ended_s and c.mode == DRIVE)
        return drive.seen_s - ended_s

    def logged_stop(self, since_s: float) -> tuple[float, str]:
        """Wait for the edge runtime's safe stop after ``since_s``; return its time and reason."""

        def stops() -> list[tuple[float, str]]:
            matches = ((s, _STOPPED.search(line)) for s, line in self.edge.lines if s > since_s)
            return [(s, match[1] or "") for s, match in matches if match]

        first: tuple[float, str] = wait_until(stops, "safe_stop in the log")[0]
        return first

    def last_drive_s(self) -> float:
        times = (c.seen_s for c in reversed(self.timeline.commands) if c.mode == DRIVE)
        return next(times, float("-inf"))

    def last_state_s(self, before_s: float) -> float:
        return max(s for s in list(self.timeline.states.values()) if s < before_s)

    def edge_counts(self) -> Counter[str]:
        """Return the edge's rejections by reason, counting all messages sent so far."""
        time.sleep(_HEALTH_S)
        count = len(self.timeline.health)
        wait_until(lambda: len(self.timeline.health) > count, "a health message")
        return Counter(self.timeline.health[-1].rejected)

    def end_counts(self) -> Counter[str]:
        """End the drive; return the simulator's rejections by reason, from its report."""
        self.switch(inside.END, "")
        self.simulator.wait()
        report = json.loads((self._directory / "report.json").read_text())
        return Counter(report["rejected_by_simulator"])

    def _command(self, holds: Callable[[CommandSeen], bool]) -> CommandSeen:
        commands = self.timeline.commands
        command: CommandSeen = wait_until(lambda: next(filter(holds, commands), None), "a command")
        return command

    def _start(self, *arguments: str, **options: Any) -> Process:
        variables = {inside.DIRECTORY: str(self._directory)}
        return self._keep(Process(*arguments, environment=variables, **options))

    def _keep(self, process: Process) -> Process:
        self._processes.append(process)
        self._closing.callback(process.end)
        return process


class Sender:
    """The rig's own simulator: sends step after step at absolute ticks until it is stopped."""

    def __init__(self, rig: Rig) -> None:
        self.step = self.episode = 0
        self.ahead_ns = 0  # Added to the stamps: a clock set ahead
        self.running = threading.Event()
        self.running.set()
        self.lock = threading.Lock()
        self._rig = rig
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, state: State) -> None:
        """Send one acceptable state and note it as such. Hold ``lock`` to keep the order."""
        self._rig.timeline.note_state(state, time.monotonic())
        self._rig.probe.put("state", encode(state))

    def send_next(self, final: bool = False) -> None:
        with self.lock:
            self.step += 1
            self.send(self.state(self.step, final=final))

    def state(self, step: int, final: bool = False) -> State:
        stamp_ns = time.time_ns() + self.ahead_ns
        place = {"episode": self.episode, "final": final}
        return noisy_state(step, self._rig.task, sent_ns=stamp_ns, **place)

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + self._rig.period_s, time.monotonic())
            if self.running.is_set():
                self.send_next()


def noisy_state(step: int, task: Task, **changes: Any) -> State:
    """Make a valid state of the task, with noise as its observation."""
    noise = inside.noise(task, np.random.default_rng(step)).items()
    fields: dict[str, Any] = {
        "session": "campaign", "episode": 0, "step": step, "speed_mps": 3.0, "final": False,
        "sim_time_s": round(step * task.control_period_s, 6), "sent_ns": time.time_ns(),
        "observation": {name: value.tobytes() for name, value in noise},
    }  # fmt: skip
    return State(**{**fields, **changes})


class Chassis(Process):
    """``python -m hil_tests mock_hunter`` beside a rig: its faults, and its true motion."""

    def __init__(self, bus: str) -> None:
        super().__init__("hil_tests", "mock_hunter", "--bus", bus, ready="ready")

    @property
    def truth(self) -> list[tuple[float, bool]]:
        """Times (monotonic s) at which it began to move (True) or to stand, whatever it reports."""
        matches = (_TOLD.match(line) for _, line in self.lines)
        return [(float(each[1]), each[2] == "moves") for each in matches if each]

    @property
    def moves(self) -> bool:
        return any(moves for _, moves in self.truth[-1:])

    def switch(self, name: str, on: bool) -> float:
        """Switch a fault; return when it took effect, monotonic s."""
        done, count = f"{name}={'on' if on else 'off'}", len(self.lines)
        self.tell(f"{name} {'on' if on else 'off'}")
        wait_until(lambda: any(line.endswith(done) for _, line in self.lines[count:]), done)
        (line,) = (line for _, line in self.lines[count:] if line.endswith(done))
        return float(line.split()[1].removeprefix("t="))

    def stands_s(self, since_s: float, timeout_s: float) -> float:
        """Return when it stood, at or after ``since_s``; TimeoutError if it goes on moving."""
        wait_until(lambda: not self.moves, "the vehicle to stand", timeout_s)
        return max(self.truth[-1][0], since_s)

    def moved_between(self, begin_s: float, end_s: float) -> bool:
        before = [moves for since_s, moves in self.truth if since_s <= begin_s][-1:]
        return any(before + [moves for since_s, moves in self.truth if begin_s < since_s < end_s])


def free_bus() -> str:
    """Return a bus on a free port: Linux mixes buses that share a port, whatever their groups."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udp_multicast:{MULTICAST_GROUP}:{probe.getsockname()[1]}"
