"""Lock-step: the simulation waits for each answer, and latency passes in virtual time.

The network is `edge_runtime/latency/virtual_link.py`: states are really published in their virtual
order of arrival, and each real answer is awaited before it goes its virtual way back. Computing
takes no virtual time, so the same seed gives the same run on a fast and a slow machine.

One thread runs all this; Zenoh's thread only fills the inbox.
"""

from __future__ import annotations

import queue
import time

import msgspec

from bridge.clock import Publish
from bridge.command_check import CommandCheck
from edge_runtime.latency.command_hold import SILENCE_LIMIT_S, Decision
from edge_runtime.latency.model import LatencySpec
from edge_runtime.latency.virtual_link import Arrival, VirtualLink
from edge_runtime.safety import Event
from edge_runtime.wire import CONTROL_PERIOD_S, SAFE_STOP, Command, Reason, State, encode

WALL_CLOCK_REASONS = (Event.SILENT.value, Event.TOO_LONG.value)
"""Why an edge runtime that lives in wall time stops; the virtual link has its own for silence."""


class LockStepClock:
    """The clock of ``--clock lockstep``."""

    def __init__(self, publish: Publish, check: CommandCheck, spec: LatencySpec) -> None:
        self.latencies_ms: list[float] = []
        self.tick_overruns = self.missed_ticks = self.wall_clock_stalls = 0
        self._publish = publish
        self._check = check
        self._spec = spec
        self._inbox: queue.SimpleQueue[tuple[bytes, float]] = queue.SimpleQueue()
        self.begin(episode=0, seed=0)

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode at virtual time 0."""
        self._check.begin(episode)
        self._link: VirtualLink[State] = VirtualLink(
            self._spec,
            seed,
            on_heard=lambda latency_s: self.latencies_ms.append(latency_s * 1e3),
            on_stale=lambda: self._check.reject(Reason.STALE.value),
        )
        self._answered_at_s: float | None = None
        self._edge_silent = False

    def receive(self, payload: bytes) -> None:
        """Queue one command with the time at which it came."""
        self._inbox.put((payload, time.monotonic()))

    def exchange(self, state: State) -> Decision:
        """Let virtual time run from this tick to the end of its command window."""
        self._check.sent(state.step)
        self._link.send_state(state.step, state)
        while arrival := self._link.next_at_edge():
            self._arrive_at_edge(arrival)
        return self._link.decide(self._wall_silence_s())

    def newest_answer(self) -> tuple[int, float] | None:
        """The newest state of this episode that was answered, and its latency in ms."""
        step = self._link.hold.newest_step
        return None if step < 0 else (step, self.latencies_ms[-1])

    def finish(self, state: State) -> None:
        """Publish the final state at once; nobody waits for an answer to it."""
        self._check.end(state.step, self._link.hold.newest_step)
        self._publish(encode(msgspec.structs.replace(state, sent_ns=time.time_ns())))

    def close(self) -> None:
        """Nothing runs in the background."""

    def _arrive_at_edge(self, arrival: Arrival[State]) -> None:
        # The stamp is the wall clock at the real publication: virtual delays are not in it.
        payload = encode(msgspec.structs.replace(arrival.message, sent_ns=time.time_ns()))
        self._take_unasked()
        published_s = time.monotonic()
        self._publish(payload)
        if arrival.overtaken:
            return  # The edge runtime rejects it as stale, as it should, and does not answer.
        answer = self._await_answer(arrival.step, published_s)
        if answer is not None:
            command, received_s = answer
            self._link.answer(arrival, command, computing_s=received_s - published_s)

    def _take_unasked(self) -> None:
        """Empty the inbox of what came between two ticks, so that only faults are counted."""
        while not self._inbox.empty():
            self._check.read(self._inbox.get()[0])

    def _await_answer(self, step: int, published_s: float) -> tuple[Command, float] | None:
        """Wait in wall time for the answer to exactly this state, and say when it came."""
        deadline_s = self._deadline_s(published_s)
        while (wait_s := deadline_s - time.monotonic()) > 0:
            try:
                payload, received_s = self._inbox.get(timeout=wait_s)
            except queue.Empty:
                break
            command = self._check.read(payload)
            if command is None:
                continue
            if command.step == step:
                self._answered_at_s, self._edge_silent = received_s, False
                self.wall_clock_stalls += command.reason in WALL_CLOCK_REASONS
                return command, received_s
            if command.mode != SAFE_STOP:  # In safe stop the edge repeats its last answer.
                self._check.reject(Reason.STALE.value)
        self._edge_silent = True
        self.wall_clock_stalls += 1
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
