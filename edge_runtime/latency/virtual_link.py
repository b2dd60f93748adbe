"""One episode's network in virtual time: shared by lock-step and by training under latency. Pure.

Tick n stands at virtual time n T. Its state arrives at the edge runtime after the uplink's delay;
the answer takes no time, and arrives at the vehicle after the downlink's; the tick is decided at
n T + 25 ms from what has arrived by then. Who answers is the caller's business: a real edge
runtime that is waited for, or a function.

The edge runtime's rule for silence counts time, and here time is virtual: a real one, which sees
states come faster than in life, would miss the gaps. So its safety machine runs along, and what it
would not drive becomes a safe stop. It begins each episode in standby: episodes do not depend on
each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Generic, Optional, Tuple, TypeVar, Union

import msgspec

from edge_runtime.latency.command_hold import (
    COMMAND_WINDOW_S,
    ROUNDING_S,
    CommandHold,
    Decision,
)
from edge_runtime.latency.event_heap import EventHeap
from edge_runtime.latency.model import LatencySpec, make_link
from edge_runtime.safety import (
    Mode,
    Safety,
    advance,
    classify_arrival,
    classify_fresh,
    note_arrival,
)
from edge_runtime.wire import CONTROL_PERIOD_S, SAFE_STOP, Command

STATE_BYTES = 7322
COMMAND_BYTES = 217
"""What the messages take on the wire, for links of limited rate: the same for every message, so
that a longer session name or another digit does not change a drive."""

_SESSION = ""
"""An episode has one simulator."""

Message = TypeVar("Message")


@dataclass(frozen=True)
class Arrival(Generic[Message]):
    """A state that has come to the edge runtime."""

    step: int
    arrived_s: float
    message: Message
    overtaken: bool
    """One as new or newer came before it: an edge runtime rejects it, and does not answer."""


@dataclass(frozen=True)
class _Answer:
    command: Command
    sent_s: float
    """Virtual time of the state's tick."""
    computing_s: float


class VirtualLink(Generic[Message]):
    """The network between vehicle and edge runtime, and the command that the vehicle holds.

    For each tick: ``send_state``; ``next_at_edge`` and ``answer`` until None comes; ``decide``.

    Args:
        spec: delays, losses and the like.
        seed: of the episode.
        on_heard: called with each newest answer's latency in s, state sent to command received.
        on_stale: called for each answer that is not newer than the newest.
    """

    def __init__(
        self,
        spec: LatencySpec,
        seed: int,
        on_heard: Callable[[float], None] = lambda latency_s: None,
        on_stale: Callable[[], None] = lambda: None,
    ) -> None:
        self.hold = CommandHold(now_s=0.0)
        self._link = make_link(spec, seed)
        self._on_heard, self._on_stale = on_heard, on_stale
        self._under_way: EventHeap[Union[Tuple[int, Message], _Answer]] = EventHeap()
        self._newest_at_edge = -1
        self._safety = Safety()
        self._step, self._window_end_s = 0, COMMAND_WINDOW_S
        self._admitted_s = 0.0

    def send_state(self, step: int, message: Message) -> None:
        """Begin tick ``step``: its state leaves the vehicle."""
        tick_s = step * CONTROL_PERIOD_S
        self._step, self._window_end_s = step, tick_s + COMMAND_WINDOW_S
        for arrival_s in self._link.up.arrivals(tick_s, STATE_BYTES):
            self._under_way.push(arrival_s, (step, message))

    def next_at_edge(self) -> Optional[Arrival[Message]]:
        """Let time run to the next state's arrival at the edge runtime; None: the window ends."""
        while True:
            due = self._under_way.pop_due(self._window_end_s + ROUNDING_S)
            if due is None:
                return None
            now_s, message = due
            if isinstance(message, _Answer):
                self._arrive_at_vehicle(message, now_s)
                continue
            step, content = message
            overtaken = step <= self._newest_at_edge
            if not overtaken:
                self._newest_at_edge = step
                self._note_fresh(now_s)
            return Arrival(step, now_s, content, overtaken)

    def answer(self, arrival: Arrival[Message], command: Command, computing_s: float = 0.0) -> None:
        """Send the answer to the newest state back; ``computing_s`` is reported only."""
        if self._safety.mode is Mode.SAFE_STOP:
            command = msgspec.structs.replace(command, mode=SAFE_STOP, reason=self._safety.reason)
        answer = _Answer(command, arrival.step * CONTROL_PERIOD_S, computing_s)
        for arrival_s in self._link.down.arrivals(arrival.arrived_s, COMMAND_BYTES):
            self._under_way.push(arrival_s, answer)

    def decide(self, edge_silence_s: Optional[float] = None) -> Decision:
        """What the vehicle does in this tick; for ``edge_silence_s`` see ``CommandHold.decide``."""
        # Answered already, the vehicle acts at once: nothing newer can come in this tick.
        answered = self.hold.newest_step >= self._step
        acts_s = self._admitted_s if answered else self._window_end_s
        return self.hold.decide(acts_s, edge_silence_s)

    def _note_fresh(self, now_s: float) -> None:
        """What the edge runtime's safety machine makes of a fresh state's moment."""
        gap = classify_arrival(self._safety, _SESSION, now_s - ROUNDING_S, needs_rearm=False)
        if gap is not None:
            self._safety = advance(self._safety, gap)
        self._safety = note_arrival(self._safety, _SESSION, now_s)
        fresh = classify_fresh(self._safety, final=False, needs_rearm=False)
        self._safety = advance(self._safety, fresh)

    def _arrive_at_vehicle(self, answer: _Answer, now_s: float) -> None:
        answered_step = self.hold.newest_step
        if not self.hold.admit(answer.command, now_s, answer.sent_s):
            self._on_stale()
            return
        self._admitted_s = now_s
        if answer.command.step > answered_step:
            self._on_heard(now_s - answer.sent_s + answer.computing_s)
