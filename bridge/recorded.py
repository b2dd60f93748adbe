"""A recorded drive: which states the runtime answered, when they reached it, and with what.

The runtime's own stamps say when, so that a recorder that was held up changes nothing. Its clock
need not be right: the recorder's, which is monotonic, says when the runtime's is stepped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from bridge.messages import Heard
from bridge.recording import Recording, choose_vehicle, heard_of
from edge_runtime.controller import Order
from edge_runtime.safety import MAX_INFERENCE_S, Event
from edge_runtime.util import UserError
from edge_runtime.wire import (
    Command,
    Health,
    State,
    decode_command,
    decode_health,
    decode_state,
)

RUNTIME_ENDED = "runtime_ended"
"""Reason of the farewell of a runtime that is ended; no decision about a state."""
JUST_AFTER_S = 1e-6
"""A watchdog wakes at its deadline or later, never before."""
CLOCK_STEP_S = 1.0
"""Where the two clocks come apart by more than this, the runtime's has been stepped."""
RESTART_S = 0.5
"""Uptimes that disagree by more than this belong to two runtimes."""

Key = tuple[str, int, int]
"""Session, episode, step."""


class Answer(NamedTuple):
    """What was decided about a state; repetitions of the same are one answer."""

    mode: str
    reason: str
    action: tuple[float, ...]


@dataclass
class Exchange:
    """The answers to one state, and the times of the first of them."""

    arrived_s: float
    """When the state reached the runtime, seconds since the recording's first message."""
    begun_s: float
    """When the policy began with it."""
    finished_s: float
    """When the policy's answer, or the verdict that it took too long, was there."""
    last_s: float
    """When the last answer was heard, repetitions included."""
    answers: list[Answer] = field(default_factory=list)


class RecordedState(NamedTuple):
    """A state that was answered in the recording."""

    state: State
    exchange: Exchange


class RecordedDrive:
    """One vehicle's part of a recording; states are read from the file when they are needed."""

    def __init__(self, path: Path, vehicle_id: str | None) -> None:
        """Read everything but the states; UserError where nothing can be replayed."""
        self.recording = Recording(path)
        self.exchanges: dict[Key, Exchange] = {}
        self.policy_ids: list[str] = []
        self.vehicle = "none"
        self.runtime_starts_s: list[float] = []
        self.vehicle_id = choose_vehicle(self.recording, vehicle_id)
        self._zero_ns: int | None = None
        self._lead_s: tuple[int, float] | None = None
        for heard in heard_of(self.recording, self.vehicle_id):
            self._take(heard)
        if not self.exchanges:
            raise UserError(
                f"{path} holds no answered state of vehicle {self.vehicle_id} to replay"
            )

    def states(self) -> Iterator[State]:
        """Yield every state that can be read, answered or not, in order of arrival."""
        for heard in heard_of(self.recording, self.vehicle_id):
            if heard.topic == "state":
                state = decode_state(heard.payload)
                if isinstance(state, State):
                    yield state

    def answered(self) -> Iterator[RecordedState]:
        """Yield the states that reached the policy, each once."""
        done: set[Key] = set()
        for state in self.states():
            key = key_of(state)
            if key in self.exchanges and key not in done:
                done.add(key)
                yield RecordedState(state, self.exchanges[key])

    def _take(self, heard: Heard) -> None:
        if self._zero_ns is None:
            self._zero_ns = heard.arrived_ns
        heard_s = (heard.arrived_ns - self._zero_ns) * 1e-9
        if heard.topic == "command":
            command = decode_command(heard.payload)
            if isinstance(command, Command) and command.reason != RUNTIME_ENDED:
                self._take_command(command, heard_s)
        elif heard.topic == "health":
            health = decode_health(heard.payload)
            if isinstance(health, Health):
                self._take_health(health, heard_s)

    def _take_command(self, command: Command, heard_s: float) -> None:
        if command.policy_id not in self.policy_ids:
            self.policy_ids.append(command.policy_id)
        sent_s = self._sent_s(command, heard_s)
        key = (command.session, command.episode, command.step)
        if key not in self.exchanges:
            self.exchanges[key] = _first_exchange(command, sent_s)
        self.exchanges[key].last_s = sent_s
        note(self.exchanges[key].answers, command)

    def _sent_s(self, command: Command, heard_s: float) -> float:
        """When the command was sent, in the recorder's time.

        The recorder's clock leads the runtime's by as much as at the first command of that
        runtime, until a step of the latter.
        """
        stamp_s = (command.sent_ns - (self._zero_ns or 0)) * 1e-9
        runtime, lead_s = len(self.runtime_starts_s), heard_s - stamp_s
        known = self._lead_s
        if known is None or known[0] != runtime or abs(lead_s - known[1]) > CLOCK_STEP_S:
            self._lead_s = known = (runtime, lead_s)
        return stamp_s + known[1]

    def _take_health(self, health: Health, heard_s: float) -> None:
        self.vehicle = health.vehicle
        start_s = heard_s - health.uptime_s
        if not self.runtime_starts_s or start_s > self.runtime_starts_s[-1] + RESTART_S:
            self.runtime_starts_s.append(start_s)


def note(answers: list[Answer], decision: Command | Order) -> None:
    """Add what was decided to the answers to a state, unless it repeats the last one."""
    answer = Answer(decision.mode, decision.reason, tuple(decision.action))
    if not answers or answers[-1] != answer:
        answers.append(answer)


def key_of(state: State) -> Key:
    """Return what a state and its command have in common."""
    return state.session, state.episode, state.step


def _first_exchange(command: Command, sent_s: float) -> Exchange:
    """The state arrived as long before its answer as the runtime had it."""
    thought_s = max(0.0, (command.sent_ns - command.received_ns) * 1e-9)
    arrived_s = sent_s - thought_s
    begun_s = max(arrived_s, sent_s - command.inference_ns * 1e-9)
    finished_s = sent_s
    if command.inference_ns == 0 and command.reason == Event.TOO_LONG.value:
        # The watchdog's verdict; the policy is still at it.
        begun_s = arrived_s
        finished_s = max(sent_s, begun_s + MAX_INFERENCE_S + JUST_AFTER_S)
    return Exchange(arrived_s, begun_s, finished_s, sent_s)
