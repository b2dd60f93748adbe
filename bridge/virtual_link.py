"""The command that the simulated vehicle holds, and an episode's network in virtual time. Pure.

`CommandHold` is the vehicle's side of the contract's safety rule, on every clock: the newest
command is held from tick to tick; when none has arrived for 2 T, or when the command itself says
``safe_stop``, the vehicle brakes.

`VirtualLink` serves lock-step and training under latency. The caller gives the answers: those of a
real edge runtime, or of a function. An answer takes no virtual time.

A real edge runtime does not notice a gap in virtual time. So the link runs the safety machine on
virtual time itself, from standby at each episode's start, and turns into a safe stop what that
machine would not drive.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import msgspec

from bridge.network import LatencySpec, make_network
from edge_runtime.latest import Freshness
from edge_runtime.safety import (
    Event,
    Mode,
    Safety,
    advance,
    classify_arrival,
    classify_fresh,
    note_arrival,
)
from edge_runtime.wire import DRIVE, SAFE_STOP, Command, Feedback

BRAKE_PERIODS = 2  # So many T without a command, and the vehicle brakes by itself
COMMAND_WINDOW = 0.25  # Of T: a command that arrives so soon after the tick still acts in it
ROUNDING_S = 1e-9
"""Sums such as 0.3 + 0.01 + 0.015 miss 0.325 by less than this; no real delay is as short."""

NO_COMMAND = "no_command"  # Brake reason: the vehicle brakes by itself after 2 T of silence
UNKNOWN_SAFE_STOP = "safe_stop"  # Brake reason when a safe_stop command gives none of its own


@dataclass(frozen=True)
class Decision:
    """The vehicle's decision in one tick."""

    command: Command | None  # The newest command, held; None before the first of the episode
    fresh: bool  # It arrived since the decision before this one
    brake_reason: str  # Why the vehicle brakes; empty while it obeys the command
    undriven_s: float
    """Time since the newest ``drive`` command arrived (since the episode began, if none has)."""
    command_age_s: float | None = None
    """From the sending of the state that the obeyed command answers; None where none is obeyed."""
    ridden: int = 0
    """Which action of its plan ``command`` has in the place of its own; 0: its own."""
    feedback: Feedback | None = None
    """The vehicle in the loop about the tick; None without a vehicle, or where it is silent."""
    feedback_age_s: float | None = None
    """From its arrival here, before any injected delay."""
    waits: bool = False
    """The episode's first command may still be under way."""


class CommandHold:
    """The newest command of one episode, and its age; ``period_s`` is T."""

    def __init__(self, now_s: float, period_s: float) -> None:
        self._period_s, self._silence_s = period_s, BRAKE_PERIODS * period_s
        self.newest: Command | None = None
        self._heard_s = self._driven_s = self._sent_s = now_s
        self._fresh = False

    @property
    def newest_step(self) -> int:
        return -1 if self.newest is None else self.newest.step

    def admit(self, command: Command, now_s: float, sent_s: float) -> bool:
        """Take the command if it is newer than the newest one; return whether it was taken.

        ``sent_s`` is when the state was sent that the command answers.

        An edge runtime in safe stop repeats its answer to the last state it heard at rate 1/T;
        such a repetition is as good a heartbeat as a new answer. A repeated ``drive`` is not: it
        would keep a frozen controller alive.
        """
        repeats_stop = command.step == self.newest_step and command.mode == SAFE_STOP
        if command.step <= self.newest_step and not repeats_stop:
            return False
        self.newest = command
        self._heard_s, self._sent_s = now_s, sent_s
        if command.mode == DRIVE:
            self._driven_s = now_s
        self._fresh = True
        return True

    def decide(self, now_s: float, edge_silence_s: float | None = None) -> Decision:
        """Decide this tick.

        ``edge_silence_s`` is given when lock-step has waited in vain: virtual time stood still
        meanwhile, so the wall time without an answer (s) counts in its place.
        """
        brake_reason, command, ridden = "", self.newest, 0
        plan = command.plan or [] if command is not None and command.mode == DRIVE else []
        silent_s = now_s - self._heard_s
        ride_s = len(plan) * self._period_s
        if edge_silence_s is not None or silent_s > self._silence_s + ride_s + ROUNDING_S:
            brake_reason = NO_COMMAND
        elif command is not None and command.mode == SAFE_STOP:
            brake_reason = command.reason or UNKNOWN_SAFE_STOP
        elif command is not None and plan:
            ridden = min(int((silent_s + ROUNDING_S) / self._period_s), len(plan))
            if ridden:
                command = msgspec.structs.replace(command, action=plan[ridden - 1])
        fresh, self._fresh = self._fresh, False
        return Decision(
            command=command,
            fresh=fresh,
            brake_reason=brake_reason,
            undriven_s=now_s - self._driven_s if edge_silence_s is None else edge_silence_s,
            command_age_s=now_s - self._sent_s if command and not brake_reason else None,
            ridden=ridden,
            waits=command is None and edge_silence_s is None,
        )


# On the wire, for links of limited rate: the same for every message, so that a longer session name
# or another digit does not change a drive.
STATE_BYTES = 122  # Besides its observation
COMMAND_BYTES = 217

Message = TypeVar("Message")


@dataclass(frozen=True)
class Arrival(Generic[Message]):
    """A state that has reached the edge runtime."""

    step: int
    arrived_s: float
    message: Message
    overtaken: bool  # One as new came before: the edge runtime rejects this without answer.


class VirtualLink(Generic[Message]):
    """The network between vehicle and edge runtime, and the command that the vehicle holds.

    For each tick: ``send_state``; ``next_at_edge`` and ``answer`` until None comes; ``decide``.

    Args:
        spec: delays, losses and the like; or a link that is made already, for this episode alone.
        seed: of the episode.
        period_s: the control period T.
        observation_bytes: what a state carries.
        on_heard: called with each newest answer's latency in s, state sent to command received.
        on_stale: called for each answer that is not newer than the newest.
    """

    def __init__(
        self,
        spec: LatencySpec,
        seed: int,
        period_s: float,
        observation_bytes: int,
        on_heard: Callable[[float], None] = lambda latency_s: None,
        on_stale: Callable[[], None] = lambda: None,
    ) -> None:
        self._period_s, self._state_bytes = period_s, STATE_BYTES + observation_bytes
        self.hold = CommandHold(0.0, period_s)
        self._link = make_network(spec, seed)
        self._on_heard, self._on_stale = on_heard, on_stale
        # A heap by arrival time; messages of the same time keep their order.
        self._under_way: list[tuple[float, int, Callable[[float], Arrival[Message] | None]]] = []
        self._numbers = itertools.count()
        self._newest_at_edge = -1
        self._safety = Safety(period_s)
        self._freshness = Freshness(self._safety.answer_s)
        self._unanswered = -1  # The step of a state that came too late to be driven on
        self._step, self._window_end_s = 0, COMMAND_WINDOW * period_s
        self._admitted_s = 0.0

    def change(self, spec: LatencySpec, seed: int) -> None:
        """Let another network carry what is sent from now on; what is under way arrives."""
        self._link = make_network(spec, seed)

    def send_state(self, step: int, message: Message) -> None:
        """Begin tick ``step``: its state leaves the vehicle."""
        tick_s = step * self._period_s
        self._step, self._window_end_s = step, tick_s + COMMAND_WINDOW * self._period_s
        for arrival_s in self._link.up.arrivals(tick_s, self._state_bytes):
            self._push(arrival_s, partial(self._arrive_at_edge, step, message))

    def next_at_edge(self) -> Arrival[Message] | None:
        """Let time run to the next state's arrival at the edge runtime; None at window end."""
        while self._under_way and self._under_way[0][0] <= self._window_end_s + ROUNDING_S:
            now_s, _, arrive = heapq.heappop(self._under_way)
            if arrival := arrive(now_s):
                return arrival
        return None

    def _push(self, arrival_s: float, arrive: Callable[[float], Arrival[Message] | None]) -> None:
        heapq.heappush(self._under_way, (arrival_s, next(self._numbers), arrive))

    def answer(self, arrival: Arrival[Message], command: Command, computing_s: float = 0.0) -> None:
        """Send the answer to the newest state back; ``computing_s`` is reported only.

        An edge runtime that drives does not answer a state that lags too far behind.
        """
        if arrival.step == self._unanswered:
            return
        if self._safety.mode is Mode.SAFE_STOP:
            command = msgspec.structs.replace(command, mode=SAFE_STOP, reason=self._safety.reason)
        if command.plan:  # as long as the edge runtime's own silence
            ride_s = len(command.plan) * self._period_s
            self._safety = self._safety._replace(ride_s=ride_s)
        for arrival_s in self._link.down.arrivals(arrival.arrived_s, COMMAND_BYTES):
            self._push(arrival_s, partial(self._arrive_at_vehicle, command, computing_s))

    def decide(self, edge_silence_s: float | None = None) -> Decision:
        """Decide this tick; for ``edge_silence_s`` see ``CommandHold.decide``."""
        # Answered already, the vehicle acts at once: nothing newer can come in this tick.
        answered = self.hold.newest_step >= self._step
        acts_s = self._admitted_s if answered else self._window_end_s
        return self.hold.decide(acts_s, edge_silence_s)

    def _arrive_at_edge(self, step: int, message: Message, now_s: float) -> Arrival[Message]:
        overtaken = step <= self._newest_at_edge
        if not overtaken:
            self._newest_at_edge = step
            self._judge(step, now_s)
        return Arrival(step, now_s, message, overtaken)

    def _judge(self, step: int, now_s: float) -> None:
        """Let the edge runtime's safety machine judge the arrival of a newest state."""
        gap = classify_arrival(self._safety, "", now_s - ROUNDING_S, needs_rearm=False)
        if gap is not None:
            self._safety = advance(self._safety, gap)
        stands, sent_s = self._safety.mode is Mode.SAFE_STOP, step * self._period_s
        lag_s = self._freshness.lag_s("", sent_s, now_s, None, stands)
        if lag_s > self._safety.answer_s + ROUNDING_S:
            self._safety = advance(self._safety, Event.LATE)
            self._unanswered = step if self._safety.mode is Mode.DRIVE else -1
            return
        self._safety = note_arrival(self._safety, "", now_s)
        fresh = classify_fresh(self._safety, final=False, needs_rearm=False)
        self._safety = advance(self._safety, fresh)

    def _arrive_at_vehicle(self, command: Command, computing_s: float, now_s: float) -> None:
        answered_step, sent_s = self.hold.newest_step, command.step * self._period_s
        if not self.hold.admit(command, now_s, sent_s):
            self._on_stale()
            return
        self._admitted_s = now_s
        if command.step > answered_step:
            self._on_heard(now_s - sent_s + computing_s)
