"""A drive to be disturbed, of real processes.

    [mock Hunter --] edge runtime --- [relay | router ---] probe --- simulator

In place of the simulator the rig may send states itself, where a row sends states of its own.
"""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import msgspec
import numpy as np

from edge_runtime.link import ask
from edge_runtime.manifest import Task
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import MULTICAST_GROUP
from edge_runtime.wire import DRIVE, SAFE_STOP, State, encode
from hil_tests.faults import inside
from hil_tests.faults.inside import BRAKES, BRIGHT, DIRECTORY, END, ENVIRONMENT, noise
from hil_tests.faults.observe import (
    CanMonitor,
    CommandSeen,
    DriveTimeline,
    ModeSeen,
    Probe,
    longest_gap_s,
)
from hil_tests.faults.relay import Relay
from hil_tests.processes import Process, wait_until
from hil_tests.testing.messages import make_state
from hil_tests.testing.policies import TASK

E = TypeVar("E")
VEHICLE_ID = "faults"
RIDE_S = 0.5  # Of the rows with ride-through
SESSION = "campaign"
_INSIDE = "hil_tests.faults.inside"
_MODE = re.compile(r"\bmode\b.*\bnow\W+(\w+)(?:.*\breason\W+(\w+))?")
_TOLD = re.compile(r"chassis t=([\d.]+) .*motion=(\w+)")
_SWITCHED = re.compile(r"fault t=([\d.]+) (\w+)=(\w+)")
_SETTLED_PERIODS, _SETTLED_COMMANDS = 3.5, 3
_REARM_EVERY_S = 2.0
_HEALTH_S = 0.6  # Longer than a period of the health message


class Rig:
    """Start it with ``with``; it ends every process that it started.

    ``policy`` are the edge runtime's options for its policy, which is made for ``task``;
    ``vehicle`` is its ``--vehicle``. The ``directory`` is an empty one, for switches and reports.
    Edge runtime and probe meet at a ``relay`` or a ``router`` where ``between`` says so. ``sender``
    sends states here, without a simulator. With the vehicle ``hunter`` there is a mock of it on a
    CAN bus. The attributes below exist only where the options ask for them.
    """

    simulator: Process
    sender: Sender
    relay: Relay
    router: Process
    chassis: ChassisProcess
    monitor: CanMonitor

    def __init__(
        self,
        policy: Sequence[str],
        directory: Path,
        task: Task = TASK,
        between: str = "",
        vehicle: str = "none",
        sender: bool = False,
        ride_s: float = 0.0,
    ) -> None:
        self.timeline = DriveTimeline()
        self.directory = directory
        self.crashes: list[str] = []
        self._policy, self._vehicle = policy, vehicle
        if ride_s:
            (directory / "edge.toml").write_text(f"[ride_through]\nmax_s = {ride_s}\n")
            self._policy = (*policy, "--config", str(directory / "edge.toml"))
        self._processes: list[tuple[str, Process]] = []
        self.task = task
        self.period_s = task.control_period_s
        (directory / BRAKES).touch()
        (directory / inside.TASK).write_bytes(msgspec.json.encode(task))
        self._simulator_endpoint, self._hub = free_endpoint(), free_endpoint()
        with contextlib.ExitStack() as self._closing:  # a rig that cannot start leaves nothing
            if not sender:
                self.simulator = self.start_simulator()
            connect = None if sender else self._simulator_endpoint
            self.probe = Probe(self._hub, connect, VEHICLE_ID, self.timeline, self._closing)
            self.edge_endpoint = self._hub  # Where the edge runtime connects
            if between == "relay":
                self.relay = Relay(self._hub)
                self._closing.callback(self.relay.close)
                self.edge_endpoint = self.relay.endpoint
            if between == "router":
                self.edge_endpoint = free_endpoint()
                self.router = self.start_router()
            self._bus = free_bus() if vehicle == "hunter" else ""
            if self._bus:
                self.chassis = ChassisProcess(self._bus)
                self._keep("chassis", self.chassis.process)
                self.monitor = CanMonitor(self._bus)
                self._closing.callback(self.monitor.close)
            self.edge = self.start_edge()
            if sender:
                self.sender = Sender(self.probe, task)
                self._closing.callback(self.sender.stop)
            self._closing = self._closing.pop_all()

    def start_edge(self) -> Process:
        """Start the edge runtime; do not wait for it."""
        bus = ("--bus", self._bus) if self._bus else ()
        return self._start(
            "edge", _INSIDE, "edge_runtime", "run", *self._policy, "--connect", self.edge_endpoint,
            "--vehicle-id", VEHICLE_ID, "--vehicle", self._vehicle, *bus,
        )  # fmt: skip

    def start_simulator(self) -> Process:
        """Start `bridge simulate` in real time; do not wait for it."""
        return self._start(
            "simulator", _INSIDE, "bridge", "simulate", "--env", ENVIRONMENT,
            "--clock", "realtime", "--listen", self._simulator_endpoint,
            "--vehicle-id", VEHICLE_ID, "--out", str(self.directory / "report.json"),
        )  # fmt: skip

    def start_recorder(self) -> tuple[Process, Path]:
        """Start `bridge record` of this drive into a new file, and wait until it listens."""
        path = self.directory / f"{time.monotonic_ns()}.mcap"  # a disturbed try is done again
        record = ("bridge", "record", "--out", str(path), "--connect", self._hub)
        recorder = self._start("recorder", *record, "--vehicle-id", VEHICLE_ID)
        recorder.wait_for_line("recording")
        return recorder, path

    def start_router(self) -> Process:
        """Start the router between edge and probe; do not wait for it."""
        return self._start("router", _INSIDE, "router", self.edge_endpoint, self._hub)

    def wait_until_driving(self, ready: Callable[[], bool] = lambda: True) -> None:
        """Wait until it drives steadily, its brake off, and is ``ready``; re-arm a vehicle."""
        rearmed_s = time.monotonic()

        def driving() -> bool:
            nonlocal rearmed_s
            if self.has_vehicle and time.monotonic() - rearmed_s > _REARM_EVERY_S:
                # A busy machine may have stopped it once more: the operator stays beside it.
                self.try_rearm()
                rearmed_s = time.monotonic()
            return self._is_driving() and ready()

        wait_until(driving, "a steady drive")

    @property
    def has_vehicle(self) -> bool:
        """Whether only an operator lets it drive again after a stop."""
        return self._vehicle != "none"

    def brakes(self) -> list[tuple[float, bool]]:
        """Return when the simulated vehicle's brake was pressed (True) or released so far."""
        lines = (self.directory / BRAKES).read_text().splitlines()
        return [(float(a), b == "1") for a, b in (line.split() for line in lines)]

    def switch(self, name: str, word: str | None) -> None:
        """Write a word into one of the files that the faulty ends look at; None removes it."""
        path = self.directory / name
        if word is None:
            path.unlink(missing_ok=True)
            return
        temporary = path.with_suffix(".new")
        temporary.write_text(word)
        temporary.replace(path)

    def bright(self, on: bool) -> None:
        """Turn the frames white, or back."""
        self.switch(BRIGHT, "" if on else None)

    def try_rearm(self) -> bool:
        """Ask once for a re-arm; return whether the runtime accepted it."""
        with contextlib.suppress(UserError):  # on a starved machine an answer may take too long
            return bool(ask(self._hub, VEHICLE_ID, "rearm")["accepted"])
        return False

    def rearm(self) -> None:
        """Ask for a re-arm until the runtime accepts it."""
        wait_until(self.try_rearm, "the vehicle to be re-armed")

    def drive_again(self, ready: Callable[[], bool] = lambda: True) -> float:
        """Re-arm it, wait until it drives steadily; return s until the first drive command."""
        self.rearm()
        rearmed_s = time.monotonic()
        self.wait_until_driving(ready)
        return self.recovered_after_s(rearmed_s)

    def end_drive(self) -> None:
        """Let the simulator end its episode and write its report."""
        self.switch(END, "")
        self.simulator.wait()

    def last_drive_s(self) -> float:
        """Return when the newest drive command came; -inf before the first."""
        times = (c.seen_s for c in reversed(self.timeline.commands) if c.mode == DRIVE)
        return next(times, float("-inf"))

    def last_state_s(self, before_s: float) -> float:
        """Return when the probe saw the newest state before ``before_s``."""
        return max(s for s in list(self.timeline.states.values()) if s < before_s)

    def last_answered_s(self, before_s: float) -> float:
        """Return when the probe saw the newest state that a drive command had answered by then."""
        states, commands = self.timeline.states, self.timeline.commands
        answered = (c.place for c in commands if c.mode == DRIVE and c.seen_s < before_s)
        return max(states[place] for place in answered if place in states)

    def own_brake_s(self, since_s: float) -> float:
        """Wait for the simulated vehicle's own brake after ``since_s``; return when it went on."""
        return _first(
            lambda: (at_s for at_s, on in self.brakes() if on and at_s > since_s),
            "the simulator's own brake",
        )

    def stop_command(self, since_s: float) -> CommandSeen:
        """Wait for the first safe_stop command after ``since_s``."""
        commands = self.timeline.commands
        return _first(
            lambda: (c for c in commands if c.seen_s > since_s and c.mode == SAFE_STOP),
            "a safe_stop command",
        )

    def logged_stop(self, since_s: float) -> ModeSeen:
        """Wait for the edge runtime's safe stop in its log after ``since_s``."""
        modes = self.timeline.modes
        return _first(
            lambda: (m for m in modes if m.seen_s > since_s and m.mode == SAFE_STOP),
            "safe_stop in the log",
        )

    def recovered_after_s(self, ended_s: float) -> float:
        """Wait for the first drive command sent after the fault's end; return s until it came."""
        commands = self.timeline.commands
        # By its sending: what a relay held up was driven before.
        command = _first(
            lambda: (c for c in commands if c.sent_s > ended_s and c.mode == DRIVE),
            "a drive command",
        )
        return command.seen_s - ended_s

    def must_stop_first(self, since_s: float) -> list[str]:
        """Return a line where the first command after a silence is a drive."""
        modes = (c.mode for c in self.timeline.commands if c.sent_s > since_s)
        return ["drove on without a safe stop"] if next(modes, "") == DRIVE else []

    def longest_gap(self, begin_s: float, end_s: float) -> float:
        """Return the longest time without a command at the probe, s."""
        return longest_gap_s([c.seen_s for c in self.timeline.commands], begin_s, end_s)

    def edge_counts(self) -> Counter[str]:
        """Return the edge's rejections by reason, counting all messages sent so far."""
        time.sleep(_HEALTH_S)
        seen = len(self.probe.health)
        wait_until(lambda: len(self.probe.health) > seen, "a health message")
        return Counter(self.probe.health[-1].rejected)

    def simulator_counts(self) -> Counter[str]:
        """Return the simulator's rejections by reason, from the report that it wrote at its end."""
        report = json.loads((self.directory / "report.json").read_text())
        return Counter(report["rejected_by_simulator"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        for name, process in self._processes:
            if process.crashed():
                self.crashes.append(f"{name}: {process.lines[-1:]}")
        self._closing.close()

    def _keep(self, name: str, process: Process) -> None:
        self._processes.append((name, process))
        self._closing.callback(process.end)

    def _is_driving(self) -> bool:
        now_s, settled_s = time.monotonic(), _SETTLED_PERIODS * self.period_s
        recent = [c for c in self.timeline.commands[-10:] if now_s - c.seen_s < settled_s]
        steady = len(recent) >= _SETTLED_COMMANDS and {c.mode for c in recent} == {"drive"}
        brakes = self.brakes()
        return steady and not (brakes and brakes[-1][1])

    def _start(self, name: str, *arguments: str) -> Process:
        def on_line(seen_s: float, line: str) -> None:
            if name == "edge" and (found := _MODE.search(line)):
                self.timeline.modes.append(ModeSeen(seen_s, found[1], found[2] or ""))

        process = Process(*arguments, environment={DIRECTORY: str(self.directory)}, on_line=on_line)
        self._keep(name, process)
        return process


def _first(events: Callable[[], Iterator[E]], what: str) -> E:
    """Wait for the first of the events and return it; TimeoutError."""
    found: E = wait_until(lambda: next(events(), None), what)
    return found


class Sender:
    """The rig's own simulator: sends step after step at absolute ticks until it is stopped."""

    def __init__(self, probe: Probe, task: Task) -> None:
        self.step = 0
        self.running = threading.Event()
        self.running.set()
        self.lock = threading.Lock()
        self._probe, self._task = probe, task
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, state: State) -> None:
        """Send one acceptable state and note it as such. Hold ``lock`` to keep the order."""
        self._probe.note_state(state, time.monotonic())
        self._probe.put("state", encode(state))

    def send_next(self, final: bool = False) -> None:
        """Send the next step now."""
        with self.lock:
            self.step += 1
            self.send(noisy_state(self.step, self._task, final=final))

    def end_episode(self) -> None:
        """Send a final state, and no other until ``running`` is set."""
        self.running.clear()
        self.send_next(final=True)

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + self._task.control_period_s, time.monotonic())
            if self.running.is_set():
                self.send_next()


def noisy_state(step: int, task: Task = TASK, **changes: Any) -> State:
    """Make a valid state of the task, which sees noise."""
    seen = noise(task, np.random.default_rng(step)).items()
    fields: dict[str, Any] = {
        "session": SESSION, "sim_time_s": round(step * task.control_period_s, 6), "speed_mps": 3.0,
        "observation": {name: value.tobytes() for name, value in seen},
    }  # fmt: skip
    return make_state(step, **{**fields, **changes})


class Truth(NamedTuple):
    """Whether the mock moves from this moment (monotonic) on, whatever it reports."""

    since_s: float
    moves: bool


class ChassisProcess:
    """``python -m hil_tests mock_hunter`` beside a rig: its faults, and what it really did."""

    def __init__(self, bus: str, *arguments: str) -> None:
        self.truth: list[Truth] = []
        self.switched: list[tuple[float, str, str]] = []
        command = ["hil_tests", "mock_hunter", "--bus", bus, *arguments]
        self.process = Process(*command, told=True, on_line=self._on_line, ready="ready")

    @property
    def moves(self) -> bool:
        """Whether it moves now."""
        return bool(self.truth) and self.truth[-1].moves

    def switch(self, name: str, on: bool) -> float:
        """Switch a fault; return when it took effect, monotonic s."""
        count, order = len(self.switched), (name, "on" if on else "off")
        self.process.tell(" ".join(order))
        done = wait_until(
            lambda: [s for s in self.switched[count:] if s[1:] == order], f"fault {order}"
        )
        return float(done[0][0])

    def stands_s(self, since_s: float, timeout_s: float) -> float:
        """Return when it stood, at or after a moment; TimeoutError where it goes on moving."""
        wait_until(lambda: not self.moves, "the vehicle to stand", timeout_s)
        return max(self.truth[-1].since_s, since_s)

    def moved_between(self, begin_s: float, end_s: float) -> bool:
        """Return whether it moved at any moment in between."""
        before = [one for one in self.truth if one.since_s <= begin_s][-1:]
        inside = [one for one in self.truth if begin_s < one.since_s < end_s]
        return any(one.moves for one in before + inside)

    def _on_line(self, seen_s: float, line: str) -> None:
        if told := _TOLD.match(line):
            self.truth.append(Truth(float(told[1]), told[2] == "moves"))
        if switched := _SWITCHED.match(line):
            self.switched.append((float(switched[1]), switched[2], switched[3]))


def free_bus() -> str:
    """Return a bus of its own: Linux mixes buses that share a port, whatever their groups."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", 0))
        return f"udp_multicast:{MULTICAST_GROUP}:{one.getsockname()[1]}"
