"""Real time: absolute ticks on the monotonic clock, latency by timers, nobody waits for anybody.

Tick n begins at n T after the episode's start. Its state goes out through the delay line, and
the vehicle acts at the latest 25 ms after the tick on the newest command that has arrived.

Threads: the caller's runs the ticks, Zenoh's hands in commands, the delay line's delivers both
directions. The condition guards everything that the delay line and the ticks share.
"""

from __future__ import annotations

import threading
import time
from functools import partial

import msgspec

from bridge.clock import Publish
from bridge.command_check import CommandCheck
from bridge.delay_line import DelayLine
from edge_runtime.latency.command_hold import COMMAND_WINDOW_S, CommandHold, Decision
from edge_runtime.latency.model import LatencyModel, LatencySpec, make_link
from edge_runtime.wire import CONTROL_PERIOD_S, Command, Reason, State, encode


class RealTimeClock:
    """The clock of ``--clock realtime``."""

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
