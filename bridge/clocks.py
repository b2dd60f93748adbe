"""The clocks: each sends one tick's state and returns the vehicle's decision.

In lock-step latency passes in virtual time (`VirtualLink`), and the clock waits for each answer.
Computing takes no virtual time, so a seed gives the same run on a fast and a slow machine.

Real time has absolute ticks on the monotonic clock and waits for no answer. The vehicle acts at the
latest T / 4 after a tick on the newest command that has arrived. With a vehicle in the loop
(`VehicleClock`), its newest feedback at tick n + 1 shows the effect of state n.
"""

from __future__ import annotations

import queue
import sched
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import msgspec

from bridge import inbound, network
from bridge.inbound import Decision
from edge_runtime.manifest import Layout
from edge_runtime.safety import Event
from edge_runtime.util import UserError
from edge_runtime.wire import SAFE_STOP, Command, Feedback, Reason, State, encode

Publish = Callable[[bytes], None]  # Sends an encoded state over the wire; must not block
WALL_CLOCK_REASONS = (Event.SILENT.value, Event.TOO_LONG.value)
"""Stop reasons of wall time. In lock-step they mean that the machine stalled."""
POLL_S = 0.02
STANDSTILL_MPS = 0.05
STANDSTILL_WAIT_S = 5.0
"""Longer than any robot takes to stop, shorter than the edge runtime's pause without a re-arm."""


@dataclass(eq=False)
class _Clock:
    """Drives the exchange of one episode at a time: ``begin``, ``exchange`` ..., ``finish``."""

    publish: Publish
    check: inbound.CommandCheck
    spec: network.LatencySpec
    latencies_ms: list[float] = field(default_factory=list)
    """From state sent to command received, injected delays included; one per answered state."""
    missed_ticks: int = 0
    """Whole ticks of the wall clock that passed without a state because the machine was late."""
    wall_clock_stalls: int = 0
    """States of lock-step that the edge runtime answered too late in wall time, not at all, or with
    a stop for lateness: it was gone or starved. Always 0 in real time."""

    def __post_init__(self) -> None:
        self.task = self.check.task
        self._period_s = self.task.control_period_s
        self._silence_s = inbound.BRAKE_PERIODS * self._period_s
        self._hold = inbound.CommandHold(0.0, self._period_s)
        # In real time, guards what the delay line and the ticks share; lock-step has one thread.
        self._arrived = threading.Condition()

    def rejected(self) -> Counter[str]:
        return Counter(dict(self.check.rejected))  # Another thread may go on counting

    def newest_answer(self) -> tuple[int, float] | None:
        """Return the newest answered step of this episode, and its latency in ms."""
        with self._arrived:
            step = self._hold.newest_step
            return None if step < 0 else (step, self.latencies_ms[-1])

    def finish(self, state: State) -> None:
        """Send the final state past the injected network, and drop messages under way."""
        with self._arrived:
            self.check.end(state.step)
        self.publish(self._stamped(state))

    def close(self) -> None:
        pass

    def _stamped(self, state: State) -> bytes:
        heard = self.check.heard
        return encode(msgspec.structs.replace(state, sent_ns=time.time_ns(), **heard))


class LockStepClock(_Clock):
    """Runs in one thread; Zenoh's thread only fills the inbox."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def begin(self, episode: int, seed: int) -> None:
        self.check.begin(episode)
        size = Layout(self.task).size
        self._link = network.VirtualLink[State](self.spec, seed, self._period_s, size)
        self._link.latencies_ms = self.latencies_ms  # Of the whole run
        self._hold = self._link.hold
        self._heard_s = 0.0  # Monotonic time of the last answer, or of the first state
        self._edge_silent = False

    def receive(self, payload: bytes) -> None:
        self._inbox.put(payload)

    def exchange(self, state: State) -> Decision:
        """Let virtual time run from this tick to the end of its command window."""
        self.check.sent(state.step)
        self._link.send_state(state.step, state)
        while arrival := self._link.next_at_edge():
            self._arrive_at_edge(arrival)
        for _ in range(self._link.stale):
            self.check.reject(Reason.STALE.value)
        self._link.stale = 0
        return self._link.decide(self._edge_silent)

    def _arrive_at_edge(self, arrival: network.Arrival[State]) -> None:
        # The stamp is the wall clock at the real publication: virtual delays are not in it.
        payload = self._stamped(arrival.message)
        # Commands that came between two ticks are read, too, so that faults are counted.
        while not self._inbox.empty():
            self.check.read(self._inbox.get(), time.time_ns())
        published_s = time.monotonic()
        self.publish(payload)
        if arrival.overtaken:
            return  # The edge runtime rejects it as stale and does not answer.
        if (command := self._await_answer(arrival.step, published_s)) is not None:
            self._link.answer(arrival, command, computing_s=self._heard_s - published_s)

    def _await_answer(self, step: int, published_s: float) -> Command | None:
        """Wait in wall time for the answer to exactly this state.

        Waits until 2 T after the last answer, but for T at least. Once the edge runtime is silent,
        the wait of T for each state also paces the braking steps.
        """
        self._heard_s = self._heard_s or published_s
        deadline_s = published_s + self._period_s
        if not self._edge_silent:
            deadline_s = max(deadline_s, self._heard_s + self._silence_s)
        while (wait_s := deadline_s - time.monotonic()) > 0:
            try:
                payload = self._inbox.get(timeout=wait_s)
            except queue.Empty:
                break
            if (command := self.check.read(payload, time.time_ns())) is None:
                continue
            if command.step == step:
                self._heard_s, self._edge_silent = time.monotonic(), False
                self.wall_clock_stalls += command.reason in WALL_CLOCK_REASONS
                return command
            if command.mode != SAFE_STOP:  # In safe stop the edge repeats its last answer.
                self.check.reject(Reason.STALE.value)
        self._edge_silent = True
        self.wall_clock_stalls += 1
        return None


class RealTimeClock(_Clock):
    """The caller's thread runs the ticks, Zenoh's takes commands, a delay line delivers both."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._window_s = network.COMMAND_WINDOW * self._period_s
        self._line = DelayLine()
        self.begin(episode=0, seed=0)

    def begin(self, episode: int, seed: int) -> None:
        with self._arrived:
            self.check.begin(episode)
            self._start_s = self._begun_s = time.monotonic()
            self._network = network.make_network(self.spec, seed)
            self._hold = inbound.CommandHold(self._start_s, self._period_s)
            self._sent_s: dict[int, float] = {}

    def receive(self, payload: bytes) -> None:
        self._send(self._network.down, payload, self._arrive_at_vehicle)

    def exchange(self, state: State) -> Decision:
        """Wait for the tick, send its state, and decide when its command window closes."""
        window_end_s = self._send_state(state) + self._window_s
        with self._arrived:
            # An answered state ends the wait: nothing newer can arrive.
            self._arrived.wait_for(
                lambda: self._hold.newest_step >= state.step,
                timeout=max(0.0, window_end_s - time.monotonic()),
            )
            return self._hold.decide(time.monotonic())

    def finish(self, state: State) -> None:
        self._line.clear()
        super().finish(state)

    def close(self) -> None:
        self._line.close()

    def _send_state(self, state: State) -> float:
        tick_s = self._wait_for_tick(state.step)
        payload = self._stamped(state)
        with self._arrived:
            self._sent_s[state.step] = time.monotonic()
            self.check.sent(state.step)
        self._send(self._network.up, payload, self.publish)
        return tick_s

    def _send(self, direction: network.LatencyModel, payload: bytes, deliver: Publish) -> None:
        # The model's time starts with the episode, so that its outages come as in lock-step.
        sent_s = time.monotonic() - self._begun_s
        for arrival_s in direction.arrivals(sent_s, len(payload)):
            self._line.push(self._begun_s + arrival_s, partial(deliver, payload))

    def _wait_for_tick(self, step: int) -> float:
        """Sleep until the tick and return its time; a missed one moves all later ones.

        No edge runtime could follow several ticks at once.
        """
        tick_s = self._start_s + step * self._period_s
        late_s = time.monotonic() - tick_s
        if late_s > self._window_s:
            self.missed_ticks += int(late_s / self._period_s)
            self._start_s += late_s
            return tick_s + late_s
        time.sleep(max(0.0, -late_s))
        return tick_s

    def _arrive_at_vehicle(self, payload: bytes) -> None:
        now_s = time.monotonic()
        with self._arrived:
            if (command := self.check.read(payload, time.time_ns())) is None:
                return
            answered_step = self._hold.newest_step
            if not self._hold.admit(command, now_s):
                self.check.reject(Reason.STALE.value)
                return
            if command.step > answered_step:
                self.latencies_ms.append((now_s - self._sent_s[command.step]) * 1e3)
            self._arrived.notify()


class VehicleClock(RealTimeClock):
    """The clock of ``--loop vehicle``; keeps the vehicle's name and faults for the report."""

    def __post_init__(self) -> None:
        self.vehicle = ""
        self.faults: Counter[str] = Counter()  # Feedback messages with each fault
        self.feedback_check = inbound.FeedbackCheck(self.check)
        super().__post_init__()

    def begin(self, episode: int, seed: int) -> None:
        super().begin(episode, seed)
        with self._arrived:
            # A random stream of its own, so that commands meet the same delays as without it.
            self._feedback_way = network.make_network(self.spec, seed + 1).down

    def receive_feedback(self, payload: bytes) -> None:
        self._send(self._feedback_way, payload, self._feedback_arrives)

    def wait_for_vehicle(self, limit_s: float, start: str) -> None:
        """Wait until a vehicle reports; UserError after ``limit_s``, with the command ``start``."""
        if not self._wait_until(lambda _: True, limit_s):
            raise UserError(f"no vehicle reports after {limit_s:g} s; start one: {start}")

    def wait_for_standstill(self) -> None:
        self._wait_until(lambda it: abs(it.speed_mps) < STANDSTILL_MPS, STANDSTILL_WAIT_S)

    def exchange(self, state: State) -> Decision:
        """Wait for the tick, send its state, and return the vehicle's decision at the next tick."""
        end_s = self._send_state(state) + self._period_s
        time.sleep(max(0.0, end_s - time.monotonic()))
        with self._arrived:
            now_s = time.monotonic()
            return self.feedback_check.decide(self._hold.decide(now_s), state.episode, now_s)

    def _feedback_arrives(self, payload: bytes) -> None:
        with self._arrived:
            feedback = self.feedback_check.read(payload, time.monotonic())
            if feedback is not None:
                self.vehicle = feedback.vehicle
                self.faults.update(feedback.faults)

    def _wait_until(self, holds: Callable[[Feedback], bool], limit_s: float) -> bool:
        """Return whether a feedback, of any session, satisfies ``holds`` before ``limit_s``."""
        give_up_s = time.monotonic() + limit_s
        while (now_s := time.monotonic()) < give_up_s:
            with self._arrived:
                heard, heard_s = self.feedback_check.heard, self.feedback_check.heard_s
            if heard is not None and now_s - heard_s <= self._silence_s and holds(heard):
                return True
            time.sleep(POLL_S)
        return False


class DelayLine:
    """Runs actions at their time (monotonic), on a thread that ``close`` ends.

    An action's exception ends the line, and is raised by the next ``push`` or ``close``.
    """

    def __init__(self) -> None:
        self.clear()
        self._changed = threading.Event()
        self._closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="delay-line", daemon=True)
        self._thread.start()

    def push(self, release_s: float, action: Callable[[], None]) -> None:
        """Run ``action`` at ``release_s`` (monotonic seconds); at once if that has passed."""
        if self._failure is not None:
            raise self._failure
        self._actions.enterabs(release_s, 0, action)  # Those of the same time keep their order
        self._changed.set()

    def clear(self) -> None:
        self._actions = sched.scheduler(time.monotonic)

    def close(self) -> None:
        self._closed = True
        self._changed.set()
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while not self._closed:
                self._changed.wait(self._actions.run(blocking=False))
                self._changed.clear()
        except Exception as error:  # Raised by the next `push` or `close`
            self._failure = error


Clock = LockStepClock | RealTimeClock
LOCKSTEP, REALTIME = "lockstep", "realtime"
CLOCKS: dict[str, type[Clock]] = {LOCKSTEP: LockStepClock, REALTIME: RealTimeClock}
