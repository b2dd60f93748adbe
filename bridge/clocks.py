"""The two clocks: each carries one tick's state out and brings the vehicle's decision back.

Lock-step waits for each answer, and latency passes in virtual time (`virtual_link.py`): states are
really published in their virtual order of arrival, and each real answer is awaited before it goes
its virtual way back. Computing takes no virtual time, so the same seed gives the same run on a fast
and a slow machine.

Real time has absolute ticks on the monotonic clock and waits for nobody. Tick n begins at n T after
the episode's start; its state goes out through the delay line, and the vehicle acts at the latest
25 ms after the tick on the newest command that has arrived.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

import msgspec

from bridge.inbound import CommandCheck
from bridge.network import EventHeap, LatencyModel, LatencySpec, make_link
from bridge.virtual_link import (
    COMMAND_WINDOW_S,
    SILENCE_LIMIT_S,
    Arrival,
    CommandHold,
    Decision,
    VirtualLink,
)
from edge_runtime.safety import Event
from edge_runtime.wire import CONTROL_PERIOD_S, SAFE_STOP, Command, Reason, State, encode

Publish = Callable[[bytes], None]
"""Sends an encoded state over the wire; must not block."""
WALL_CLOCK_REASONS = (Event.SILENT.value, Event.TOO_LONG.value)
"""Why an edge runtime that lives in wall time stops; the virtual link has its own for silence."""


class Clock(Protocol):
    """Drives the exchange of one episode at a time; ``begin``, ``exchange`` ..., ``finish``."""

    latencies_ms: list[float]
    """From state sent to command received, injected delays included; one per answered state."""
    tick_overruns: int
    """Ticks that began so late that the simulation slipped behind the wall clock."""
    missed_ticks: int
    """Whole ticks of the wall clock that went by without a state because of it."""
    wall_clock_stalls: int
    """States of lock-step that the edge runtime did not answer in wall time, or only with a safe
    stop because of it: it was gone, or got no processor. Always 0 in real time."""

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode; ``seed`` decides the delays and losses of the link."""

    def receive(self, payload: bytes) -> None:
        """Take one command from the wire, on Zenoh's thread."""

    def exchange(self, state: State) -> Decision:
        """Send the state of one tick and decide what the vehicle does in it."""

    def newest_answer(self) -> tuple[int, float] | None:
        """The newest state of this episode that was answered, and its latency in ms."""

    def finish(self, state: State) -> None:
        """Send the final state. It says that the simulation has ended, which no radio link
        carries, so no delay or loss is injected; whatever is still under way is forgotten.
        """

    def close(self) -> None:
        """Stop any thread."""


class LockStepClock:
    """The clock of ``--clock lockstep``.

    One thread runs all this; Zenoh's thread only fills the inbox.
    """

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


class RealTimeClock:
    """The clock of ``--clock realtime``.

    The caller's thread runs the ticks, Zenoh's hands in commands, the delay line's delivers both
    directions. The condition guards everything that the delay line and the ticks share.
    """

    def __init__(self, publish: Publish, check: CommandCheck, spec: LatencySpec) -> None:
        self.latencies_ms: list[float] = []
        self.tick_overruns = self.missed_ticks = self.wall_clock_stalls = 0
        self._publish = publish
        self._check = check
        self._spec = spec
        self._line = DelayLine()
        self._arrived = threading.Condition()
        self.begin(episode=0, seed=0)

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode now."""
        with self._arrived:
            self._check.begin(episode)
            self._link = make_link(self._spec, seed)
            self._start_s = self._begun_s = time.monotonic()
            self._hold = CommandHold(now_s=self._start_s)
            self._sent_s: dict[int, float] = {}

    def receive(self, payload: bytes) -> None:
        """Send one command down the line to the vehicle."""
        self._send(self._link.down, payload, self._arrive_at_vehicle)

    def exchange(self, state: State) -> Decision:
        """Wait for the tick, send its state, and decide when its command window closes."""
        return self._decide(state.step, self._send_state(state) + COMMAND_WINDOW_S)

    def newest_answer(self) -> tuple[int, float] | None:
        """The newest state of this episode that was answered, and its latency in ms."""
        with self._arrived:
            step = self._hold.newest_step
            return None if step < 0 else (step, self.latencies_ms[-1])

    def finish(self, state: State) -> None:
        """Forget what is under way and publish the final state at once."""
        self._line.clear()
        with self._arrived:
            self._check.end(state.step, self._hold.newest_step)
        self._publish(encode(_stamp(state)))

    def close(self) -> None:
        """Stop the delay line."""
        self._line.close()

    def _send_state(self, state: State) -> float:
        """Wait for the state's tick, send it, and return the tick's time."""
        tick_s = self._wait_for_tick(state.step)
        payload = encode(_stamp(state))
        with self._arrived:
            self._sent_s[state.step] = time.monotonic()
            self._check.sent(state.step)
        self._send(self._link.up, payload, self._publish)
        return tick_s

    def _send(self, direction: LatencyModel, payload: bytes, deliver: Publish) -> None:
        # The model's time is the episode's, so that its outages come as in lock-step.
        sent_s = time.monotonic() - self._begun_s
        for arrival_s in direction.arrivals(sent_s, len(payload)):
            self._line.push(self._begun_s + arrival_s, partial(deliver, payload))

    def _wait_for_tick(self, step: int) -> float:
        """Sleep until the tick and return its time; a tick missed altogether moves all later ones.

        Catching up instead would run several ticks at once, at a pace no edge runtime can follow.
        """
        tick_s = self._start_s + step * CONTROL_PERIOD_S
        late_s = time.monotonic() - tick_s
        if late_s > COMMAND_WINDOW_S:
            self.tick_overruns += 1
            self.missed_ticks += int(late_s / CONTROL_PERIOD_S)
            self._start_s += late_s
            return tick_s + late_s
        time.sleep(max(0.0, -late_s))
        return tick_s

    def _decide(self, step: int, window_end_s: float) -> Decision:
        """Return early if this state is already answered: nothing newer can arrive."""
        with self._arrived:
            self._arrived.wait_for(
                lambda: self._hold.newest_step >= step,
                timeout=max(0.0, window_end_s - time.monotonic()),
            )
            return self._hold.decide(time.monotonic())

    def _arrive_at_vehicle(self, payload: bytes) -> None:
        now_s = time.monotonic()
        with self._arrived:
            command = self._check.read(payload)
            if command is None:
                return
            answered_step = self._hold.newest_step
            if not self._hold.admit(command, now_s, self._sent_s[command.step]):
                self._check.reject(Reason.STALE.value)
                return
            if command.step > answered_step:
                self.latencies_ms.append((now_s - self._sent_s[command.step]) * 1e3)
            self._admitted(command)
            self._arrived.notify()

    def _admitted(self, command: Command) -> None:
        """Look at a command that the vehicle takes; the caller holds the condition."""


def _stamp(state: State) -> State:
    """Return the state with the wall clock at which it is sent."""
    return msgspec.structs.replace(state, sent_ns=time.time_ns())


REALTIME = "realtime"
CLOCKS: dict[str, Callable[[Publish, CommandCheck, LatencySpec], Clock]] = {
    "lockstep": LockStepClock,
    REALTIME: RealTimeClock,
}
Action = Callable[[], None]


class DelayLine:
    """Runs actions at their time on the monotonic clock, on a thread of its own.

    ``close`` ends the thread; as a daemon, a forgotten one does not hold up the process's end.
    What an action raises ends the line, and is raised by the next ``push`` or ``close``.
    """

    def __init__(self) -> None:
        self._heap: EventHeap[Action] = EventHeap()
        self._changed = threading.Condition()
        self._closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="delay-line", daemon=True)
        self._thread.start()

    def push(self, release_s: float, action: Action) -> None:
        """Run ``action`` at ``release_s`` (monotonic seconds); at once if that has passed."""
        with self._changed:
            self._raise_failure()
            self._heap.push(release_s, action)
            self._changed.notify()

    def clear(self) -> None:
        """Forget what is still under way."""
        with self._changed:
            self._heap.clear()

    def close(self) -> None:
        """Stop the thread and wait for it."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._raise_failure()

    def _run(self) -> None:
        try:
            while (action := self._next_action()) is not None:
                action()
        except Exception as error:  # Handed to whoever uses the line.
            self._failure = error

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _next_action(self) -> Action | None:
        """Sleep until an action is due and return it; None once the line is closed."""
        with self._changed:
            while not self._closed:
                due = self._heap.pop_due(time.monotonic())
                if due is not None:
                    return due[1]
                next_s = self._heap.next_arrival_s()
                self._changed.wait(None if next_s is None else next_s - time.monotonic())
        return None
