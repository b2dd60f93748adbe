"""``--loop vehicle``: real time with a vehicle in the loop, whose motion the simulation follows.

State n goes out at tick n, as ever; the vehicle is moved by its edge runtime, and at tick n + 1 its
newest feedback says what came of that. Nothing is decided here: a vehicle waits for nobody, brakes
by its own rules, and the simulation follows it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from bridge.clocks import Publish, RealTimeClock
from bridge.episode import Apply, vehicle_action
from bridge.inbound import CommandCheck, FeedbackCheck, FeedbackHold, VehicleDecision
from bridge.network import LatencySpec, make_link
from bridge.ports import SimulatorPort
from bridge.report import STANDSTILL_MPS, quantiles
from bridge.tracking import TrackingLog
from bridge.virtual_link import SILENCE_LIMIT_S
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S, Command, Feedback, State

POLL_S = 0.02
STANDSTILL_WAIT_S = 5.0
"""Longer than any robot takes to stop, shorter than the edge runtime's pause without a re-arm."""


class VehicleClock(RealTimeClock):
    """The clock of ``--loop vehicle``. ``tracking`` keeps what was asked, and what became of it."""

    def __init__(
        self, publish: Publish, check: CommandCheck, spec: LatencySpec, feedback: FeedbackCheck
    ) -> None:
        self.tracking = TrackingLog()
        self.feedback_ages_ms: list[float] = []
        """At each tick's end, of the feedback that moved the car."""
        self.moving_starts = 0
        self.feedback_check = feedback
        self._feedback = FeedbackHold(time.monotonic())
        super().__init__(publish, check, spec)

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode now; the vehicle stands, or is counted as moving."""
        super().begin(episode, seed)
        with self._arrived:
            # Its own stream, so that commands meet the same luck as without it; so has the relay.
            self._feedback_link = make_link(self._spec, seed + 1).down
            self.tracking.begin()

    def receive_feedback(self, payload: bytes) -> None:
        """Send one feedback down the line to the simulation, on Zenoh's thread."""
        received_s = time.monotonic()
        arrive = partial(self._feedback_arrives, received_s=received_s)
        self._send(self._feedback_link, payload, arrive)

    def wait_for_vehicle(self, limit_s: float, vehicle_id: str) -> None:
        """Wait until the vehicle reports; UserError after ``limit_s``."""
        if not self._wait_until(lambda _: True, limit_s):
            raise UserError(
                f"no feedback from a vehicle of {vehicle_id} after {limit_s:g} s; give its edge "
                "runtime one: python -m edge_runtime run --vehicle NAME"
            )

    def wait_for_standstill(self) -> None:
        """Wait until the vehicle stands; where it does not, count that and go on."""
        self.moving_starts += not self._wait_until(_stands, STANDSTILL_WAIT_S)

    def exchange(self, state: State) -> VehicleDecision:
        """Wait for the tick, send its state, and at the next tick say what the vehicle has done."""
        end_s = self._send_state(state) + CONTROL_PERIOD_S
        time.sleep(max(0.0, end_s - time.monotonic()))
        with self._arrived:
            now_s = time.monotonic()
            decision = self._feedback.decide(self._hold.decide(now_s), state.episode, now_s)
        if decision.feedback_age_s is not None:
            self.feedback_ages_ms.append(decision.feedback_age_s * 1e3)
        return decision

    def finish(self, state: State) -> None:
        """Publish the final state at once; the vehicle is to stop."""
        with self._arrived:
            self.feedback_check.sent(state.episode, state.step)
            self.tracking.end()
        super().finish(state)

    def _send_state(self, state: State) -> float:
        with self._arrived:
            self.feedback_check.sent(state.episode, state.step)
        return super()._send_state(state)

    def _admitted(self, command: Command) -> None:
        self.tracking.command(command)

    def _feedback_arrives(self, payload: bytes, received_s: float) -> None:
        now_s = time.monotonic()
        with self._arrived:
            feedback = self.feedback_check.read(payload, now_s)
            if feedback is None:
                return
            self._feedback.admit(feedback, received_s, now_s)
            self.tracking.feedback(feedback)

    def _wait_until(self, holds: Callable[[Feedback], bool], limit_s: float) -> bool:
        """Whether it holds for what the vehicle says, of whichever drive, before ``limit_s``."""
        give_up_s = time.monotonic() + limit_s
        while time.monotonic() < give_up_s:
            with self._arrived:
                heard, heard_s = self.feedback_check.heard, self.feedback_check.heard_s
            if heard is not None and time.monotonic() - heard_s <= SILENCE_LIMIT_S and holds(heard):
                return True
            time.sleep(POLL_S)
        return False


def _stands(feedback: Feedback) -> bool:
    return abs(feedback.speed_mps) < STANDSTILL_MPS


class VehicleInLoop:
    """A vehicle that reports through ``port``; UserError if none does within ``wait_s``."""

    def __init__(self, clock: VehicleClock, port: SimulatorPort, wait_s: float) -> None:
        self.clock = clock
        manifest = port.edge_manifest()
        self._action_names = [action.name for action in manifest.action] if manifest else []
        self.apply: Apply = vehicle_action(self._action_names)
        port.on_feedback(clock.receive_feedback)
        clock.wait_for_vehicle(wait_s, port.vehicle_id)

    def rejected(self) -> Counter[str]:
        """Return the feedback that was not believed, as ``feedback_REASON``."""
        counts = dict(self.clock.feedback_check.rejected)  # Its own thread goes on counting.
        return Counter({f"feedback_{name}": n for name, n in counts.items()})

    def report(self) -> dict[str, Any]:
        """Return the report's part ``vehicle``."""
        return {
            **self.clock.tracking.report(self._action_names),
            "feedback_age_ms": quantiles(self.clock.feedback_ages_ms),
            "moving_starts": self.clock.moving_starts,
        }
