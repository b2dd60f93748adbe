"""Probes between the two ends of a drive (Zenoh, TCP, CAN), and their observations.

Times are monotonic seconds: one clock for all processes of a machine.
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import can
import zenoh

from bridge.messages import DECODERS
from edge_runtime import wire
from edge_runtime.manifest import Task
from edge_runtime.transport import open_session
from edge_runtime.vehicles.hunter import open_bus, parse_bus
from edge_runtime.vehicles.hunter.protocol import FRAMES
from edge_runtime.wire import DRIVE, SAFE_STOP
from hil_tests.faults.policies import TASK, VEHICLE_ID

REACTION_LIMIT_S = 2 * TASK.control_period_s + 0.05
"""From the last good state to a safe stop on the wire, or to the other end's own brake."""
RECOVERY_LIMIT_S = 1.0
"""From the end of the fault to the first drive command, with no vehicle attached."""
SET_POINT, STATUS, SPEED = HEARD = (0x111, 0x211, 0x221)
_LOOPBACK = "127.0.0.1"
_CHUNK_BYTES = 4096  # Small, so that a throttled relay passes data on smoothly

Place = tuple[str, int, int]  # Session, episode and step of a state


class CommandSeen(NamedTuple):
    """A command that reached the probe; ``sent_s`` by the edge's wall clock, made monotonic."""

    seen_s: float
    sent_s: float
    place: Place
    mode: str
    action: list[float]
    reason: str


@dataclass
class DriveTimeline:
    """Events in order of arrival. Threads only append."""

    states: dict[Place, float] = field(default_factory=dict)  # Those that a policy may answer
    flow_s: list[float] = field(default_factory=list)
    """Arrivals of the drive's own states: a gap is a stall of the machine, or the fault's."""
    commands: list[CommandSeen] = field(default_factory=list)
    feedback: list[tuple[float, wire.Feedback]] = field(default_factory=list)
    health: list[wire.Health] = field(default_factory=list)
    unreadable: int = 0  # Commands that no receiver can decode

    def note_state(self, state: wire.State, seen_s: float) -> None:
        self.states.setdefault((state.session, state.episode, state.step), seen_s)
        self.flow_s.append(seen_s)

    def longest_gap_s(self, begin_s: float, end_s: float) -> float:
        return longest_gap_s([c.seen_s for c in self.commands], begin_s, end_s)

    def stops_between(self, begin_s: float, end_s: float) -> list[str]:
        """Return a line for each reason of safe stops in between, where the drive should go on."""
        seen = (c for c in self.commands if begin_s < c.seen_s < end_s and c.mode == SAFE_STOP)
        return [f"safe stop: {reason}" for reason in dict.fromkeys(c.reason for c in seen)]

    def drives_between(self, begin_s: float, end_s: float = math.inf) -> list[str]:
        """Return a line if a drive command was sent in between, before a re-arm."""
        drove = any(begin_s < c.seen_s < end_s and c.mode == DRIVE for c in self.commands)
        return ["was told to drive before it was re-armed"] if drove else []

    def unsafe_commands(self, task: Task = TASK) -> list[str]:
        """Return a line for each unsafe command.

        A ``drive`` is unsafe outside the task's ranges, in answer to no acceptable state, and later
        than the reaction limit after its state.
        """
        limit_s = REACTION_LIMIT_S + later_s(task)
        found = [f"{self.unreadable} commands that nobody would take"] * bool(self.unreadable)
        for command in self.commands:
            if command.mode != DRIVE:
                continue
            state_s = self.states.get(command.place)
            ranges = zip(command.action, task.action, strict=False)
            inside = all(row.low <= value <= row.high for value, row in ranges)
            if len(command.action) != len(task.action) or not inside:
                found.append(f"{command.place}: action {command.action}")
            elif state_s is None:
                found.append(f"{command.place}: answers no acceptable state")
            # The edge's clock may have been stepped ahead, so `seen_s` bounds the sending, too.
            elif (age_s := min(command.sent_s, command.seen_s) - state_s) > limit_s:
                found.append(f"{command.place}: its state was {age_s:.3f} s old")
        return found


def later_s(task: Task) -> float:
    """Return by how many seconds 2 T of this task exceed 0.2 s."""
    return 2.0 * (task.control_period_s - TASK.control_period_s)


def longest_gap_s(times_s: Iterable[float], begin_s: float, end_s: float) -> float:
    inside = [begin_s, *sorted(t for t in times_s if begin_s < t < end_s), end_s]
    return max(after - before for before, after in pairwise(inside))


class Probe:
    """A Zenoh router between the two ends that notes all messages, until the ``stack`` ends.

    It listens for the edge runtime and connects to the simulator: it works with either one alone.
    """

    def __init__(
        self, listen: str, connect: str | None, timeline: DriveTimeline, stack: contextlib.ExitStack
    ) -> None:
        self._timeline = timeline
        opened = open_session(listen=listen, connect=connect, mode="router")
        self._session = stack.enter_context(opened)
        for topic in ("state", "command", "health", "feedback"):
            key, hear = wire.key(VEHICLE_ID, topic), partial(self._hear, topic)
            # Not its own messages.
            hears: Any = {"handler": hear, "allowed_origin": zenoh.Locality.REMOTE}
            stack.enter_context(self._session.declare_subscriber(key, **hears))

    def put(self, topic: str, payload: bytes) -> None:
        # BLOCK, so that no message that the campaign counts as sent is dropped.
        block = zenoh.CongestionControl.BLOCK
        self._session.put(wire.key(VEHICLE_ID, topic), payload, congestion_control=block)

    def _hear(self, topic: str, sample: zenoh.Sample) -> None:
        seen_s, offset_ns = time.monotonic(), time.time_ns() - time.monotonic_ns()
        timeline = self._timeline
        match DECODERS[topic](bytes(sample.payload)):
            case wire.State() as state:
                timeline.note_state(state, seen_s)
            case wire.Command(mode=mode, action=action, reason=reason) as command:
                place = (command.session, command.episode, command.step)
                sent_s = (command.sent_ns - offset_ns) * 1e-9
                timeline.commands.append(CommandSeen(seen_s, sent_s, place, mode, action, reason))
            case wire.Feedback() as feedback:
                timeline.feedback.append((seen_s, feedback))
            case wire.Health() as health:
                timeline.health.append(health)
            case _:
                timeline.unreadable += topic == "command"


class Relay:
    """Relays TCP from ``endpoint`` to ``target``, an endpoint of this machine."""

    def __init__(self, target: str) -> None:
        self._target = (_LOOPBACK, int(target.rpartition(":")[2]))
        self._flowing = threading.Event()
        self._flowing.set()
        self._is_cut = False
        self._bytes_per_s = math.inf
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        self._listener = socket.create_server((_LOOPBACK, 0))
        self.endpoint = f"tcp/{_LOOPBACK}:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Break every connection and refuse new ones; data under way is lost."""
        with self._lock:
            self._is_cut = True
            while self._open:
                _shut(self._open.pop())

    def stall(self) -> None:
        """Keep the connections and hold the data, as a radio link does while it retransmits."""
        self._flowing.clear()

    def throttle(self, bytes_per_s: float) -> None:
        """Limit the rate towards the side that connected; the rest of the data waits."""
        self._bytes_per_s = bytes_per_s

    def restore(self) -> None:
        """Pass all data on again; held data comes at once."""
        self._is_cut, self._bytes_per_s = False, math.inf
        self._flowing.set()

    def close(self) -> None:
        self._flowing.set()
        self.cut()
        _shut(self._listener)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near = self._listener.accept()[0]
                with self._lock:
                    if self._is_cut:
                        near.close()
                        continue
                    far = socket.create_connection(self._target)
                    self._open += [near, far]
                for pair in ((near, far, False), (far, near, True)):
                    threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, to_caller: bool) -> None:
        with contextlib.suppress(OSError):
            sink.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while data := source.recv(_CHUNK_BYTES):
                self._flowing.wait()
                if to_caller:
                    time.sleep(len(data) / self._bytes_per_s)
                sink.sendall(data)
        _shut(source)
        _shut(sink)


def _shut(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()


class CanMonitor(can.Listener):
    def __init__(self, bus: str) -> None:
        self.heard: list[tuple[float, int, bytes]] = []  # Monotonic time, identifier, data
        self.strange: list[int] = []  # Identifiers that nobody should send: not the Hunter's
        self._bus = open_bus(parse_bus(bus))
        self._notifier = can.Notifier(self._bus, [self], timeout=0.1)

    def of(self, can_id: int, since_s: float = -math.inf) -> list[tuple[float, bytes]]:
        return [(s, data) for s, heard_id, data in self.heard if heard_id == can_id and s > since_s]

    def close(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()

    def on_message_received(self, msg: can.Message) -> None:
        if msg.arbitration_id in HEARD:
            # The kernel's wall-clock stamp, so that this thread's own delay does not count.
            seen_s = msg.timestamp + time.monotonic() - time.time()
            self.heard.append((seen_s, msg.arbitration_id, bytes(msg.data)))
        if msg.arbitration_id not in FRAMES or msg.is_extended_id:
            self.strange.append(msg.arbitration_id)

    def on_error(self, exc: Exception) -> None:
        """Ignore data that is no frame."""
