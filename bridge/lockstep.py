"""Lock-step: the simulation waits for each answer, and latency passes in virtual time.

Tick n stands at virtual time n T. Its state arrives at the edge runtime after the uplink delay;
states are really published in their order of arrival, each real answer is awaited and scheduled
to arrive after the downlink delay, and the tick is decided at n T + 25 ms from what has arrived.
Computing takes no virtual time, so the same seed gives the same run on a fast and a slow machine.

One thread runs all this; Zenoh's thread only fills the inbox.
"""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass

import msgspec

from bridge.clock import Publish
from bridge.command_check import CommandCheck
from bridge.command_hold import (
    COMMAND_WINDOW_S,
    ROUNDING_S,
    SILENCE_LIMIT_S,
    CommandHold,
    Decision,
)
from edge_runtime.latency.event_heap import EventHeap
from edge_runtime.latency.model import LatencySpec, make_link
from edge_runtime.wire import CONTROL_PERIOD_S, SAFE_STOP, Command, Reason, State, encode


@dataclass(frozen=True)
class _Answer:
    command: Command
    sent_s: float
    """Virtual time of the state's tick."""
    round_trip_s: float
    """Real time from publishing the state to receiving the command."""


class LockStepClock:
    """The clock of ``--clock lockstep``."""

    def __init__(self, publish: Publish, check: CommandCheck, spec: LatencySpec) -> None:
        self.latencies_ms: list[float] = []
        self.tick_overruns = 0
        self.missed_ticks = 0
        self._publish = publish
        self._check = check
        self._spec = spec
        self._inbox: queue.SimpleQueue[tuple[bytes, float]] = queue.SimpleQueue()
        self.begin(episode=0, seed=0)

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode at virtual time 0."""
        self._check.begin(episode)
        self._link = make_link(self._spec, seed)
        self._hold = CommandHold(now_s=0.0)
        self._under_way: EventHeap[State | _Answer] = EventHeap()
        self._published_step = -1
        self._admitted_s = 0.0
        self._answered_at_s: float | None = None
        self._edge_silent = False

    def receive(self, payload: bytes) -> None:
        """Queue one command with the time at which it came."""
        self._inbox.put((payload, time.monotonic()))

    def exchange(self, state: State) -> Decision:
        """Let virtual time run from this tick to the end of its command window."""
        tick_s = state.step * CONTROL_PERIOD_S
        self._check.sent(state.step)
        self._send(self._link.up.sample(tick_s), state)
        window_end_s = tick_s + COMMAND_WINDOW_S
        while due := self._under_way.pop_due(window_end_s + ROUNDING_S):
            arrival_s, message = due
            if isinstance(message, _Answer):
                self._arrive_at_vehicle(message, arrival_s)
            else:
                self._arrive_at_edge(message, arrival_s)
        # Answered already, the vehicle acts at once: nothing newer can come in this tick.
        answered = self._hold.newest_step >= state.step
        acts_s = self._admitted_s if answered else window_end_s
        return self._hold.decide(acts_s, self._wall_silence_s())

    def finish(self, state: State) -> None:
        """Publish the final state at once; nobody waits for an answer to it."""
        self._check.end(state.step, self._hold.newest_step)
        self._publish(encode(msgspec.structs.replace(state, sent_ns=time.time_ns())))

    def close(self) -> None:
        """Nothing runs in the background."""

    def _send(self, arrival_s: float | None, message: State | _Answer) -> None:
        if arrival_s is not None:
            self._under_way.push(arrival_s, message)

    def _arrive_at_vehicle(self, answer: _Answer, now_s: float) -> None:
        if not self._hold.admit(answer.command, now_s, answer.sent_s):
            self._check.reject(Reason.STALE.value)
            return
        self._admitted_s = now_s
        self.latencies_ms.append((now_s - answer.sent_s + answer.round_trip_s) * 1e3)

    def _arrive_at_edge(self, state: State, now_s: float) -> None:
        # The stamp is the wall clock at the real publication: virtual delays are not in it.
        payload = encode(msgspec.structs.replace(state, sent_ns=time.time_ns()))
        overtaken = state.step < self._published_step
        self._take_unasked()
        published_s = time.monotonic()
        self._publish(payload)
        if overtaken:
            return  # The edge runtime rejects it as stale, as it should, and does not answer.
        self._published_step = state.step
        answer = self._await_answer(state, published_s)
        if answer is not None:
            self._send(self._link.down.sample(now_s), answer)

    def _take_unasked(self) -> None:
        """Empty the inbox of what came between two ticks, so that only faults are counted."""
        while not self._inbox.empty():
            self._check.read(self._inbox.get()[0])

    def _await_answer(self, state: State, published_s: float) -> _Answer | None:
        """Wait in wall time for the answer to exactly this state."""
        deadline_s = self._deadline_s(published_s)
        while (wait_s := deadline_s - time.monotonic()) > 0:
            try:
                payload, received_s = self._inbox.get(timeout=wait_s)
            except queue.Empty:
                break
            command = self._check.read(payload)
            if command is None:
                continue
            if command.step == state.step:
                self._answered_at_s, self._edge_silent = received_s, False
                sent_s = state.step * CONTROL_PERIOD_S
                return _Answer(command, sent_s, received_s - published_s)
            if command.mode != SAFE_STOP:  # In safe stop the edge repeats its last answer.
                self._check.reject(Reason.STALE.value)
        self._edge_silent = True
        return None

    def _deadline_s(self, published_s: float) -> float:
        """The vehicle brakes 2 T after the last answer; each state has T for its answer at least.

        Once the edge runtime is silent, T for each state is also the pace of the braking steps.
        """
        if self._edge_silent:
            return published_s + CONTROL_PERIOD_S
        if self._answered_at_s is None:
            return published_s + SILENCE_LIMIT_S
        return max(self._answered_at_s + SILENCE_LIMIT_S, published_s + CONTROL_PERIOD_S)

    def _wall_silence_s(self) -> float | None:
        """Wall time without an answer (s), if the last state really published got none."""
        if not self._edge_silent:
            return None
        return (
            SILENCE_LIMIT_S
            if self._answered_at_s is None
            else (time.monotonic() - self._answered_at_s)
        )
