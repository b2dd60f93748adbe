"""The control loop: the thin shell of clocks, threads and Zenoh around controller.py.

Three kinds of threads meet here, under one lock:
- Zenoh's receiving thread calls `_on_state`, which judges a message and leaves the newest state
  in a slot;
- the policy's thread takes the slot, infers outside the lock, and sends the answer; an exception
  that ends it is a fault of its own;
- the main thread is the watchdog: it wakes at absolute deadlines, sends safe stops and health,
  and tells systemd that all of this works.
A command is sent under the lock, so that no late answer can follow a safe stop.
"""

from __future__ import annotations

import math
import queue
import threading
import time
import traceback
from collections import deque
from typing import Any, Deque, Dict, Optional

from edge_runtime import log
from edge_runtime.controller import Controller, Order, Received
from edge_runtime.latest import LatestState
from edge_runtime.link import Link, LinkQuality, is_poor, link_words
from edge_runtime.policy import Policy, infer
from edge_runtime.safety import Event, Mode
from edge_runtime.service import WINDOW, BoardWatch, Notifier, quantiles_ms
from edge_runtime.vehicles.base import VehicleRunner
from edge_runtime.wire import HEALTH_HZ, MAX_TEXT_CHARS, Health, Rejection, is_foreign

_HEALTH_PERIOD_S = 1.0 / HEALTH_HZ
_JOIN_S = 0.5
_RETRY_S = 0.1
_FLOOD_PERIOD_S = 1.0
# A call of policy or driver that takes this long will not end: only a new process helps.
_HUNG_S = 2.0


class ControlLoop:
    """Answers states with commands until it is stopped; the log names `rearm_command`."""

    def __init__(
        self,
        policy: Policy,
        controller: Controller,
        link: Link,
        notifier: Notifier,
        vehicle: Optional[VehicleRunner] = None,
        rearm_command: str = "",
    ) -> None:
        self._policy, self._controller, self._link = policy, controller, link
        self._vehicle, self._notifier = vehicle, notifier
        self._rearm_command = rearm_command
        self._period_s = policy.manifest.control_period_s
        self._link_quality, self._is_poor = LinkQuality(), False
        self._board = BoardWatch()
        self._latest = LatestState(self._period_s)
        self._inferences_ns: Deque[int] = deque(maxlen=WINDOW)
        self._commands_ns: Deque[int] = deque(maxlen=WINDOW)
        self._busy_since_s: Optional[float] = None
        self._slot: Optional[Received] = None
        self._superseded = 0
        self._stopping = False
        self._logged = (controller.safety.mode, controller.safety.reason, False)
        self._logged_rejection_s: Dict[str, float] = {}  # by reason
        self._started_s = time.monotonic()
        # Reentrant, because the signal handler calls `stop` in the main thread at any moment.
        self._lock = threading.RLock()
        # Wakes the policy's thread: once for a state in an empty slot, once to end. Unlike a
        # Condition it wakes outside the lock, which the woken thread would have to wait for.
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._timer = threading.Condition(self._lock)
        self._worker = threading.Thread(target=self._work, name="policy", daemon=True)

    def start(self) -> None:
        self._worker.start()
        if self._vehicle is not None:
            self._vehicle.on_fault = self._wake_watchdog
        limit = self._policy.layout.max_payload_bytes
        self._link.declare(self._on_state, self.health, self._rearm, limit)

    def run(self) -> None:
        """Run the watchdog until `stop` is called."""
        next_health_s = time.monotonic()
        next_alive_s = next_health_s
        with self._lock:
            while not self._stopping:
                now_s = time.monotonic()
                self._look_at_vehicle(now_s)
                self._send(self._controller.tick(now_s))
                if now_s >= next_health_s:
                    health = self.health()
                    self._link.send("health", health)
                    self._log_link(health.link)
                    next_health_s = max(next_health_s + _HEALTH_PERIOD_S, now_s)
                if now_s >= next_alive_s and not self._is_hung(now_s):
                    self._notifier.tell("WATCHDOG=1")
                    next_alive_s = now_s + self._notifier.watchdog_period_s
                self._sleep(min(next_health_s, max(next_alive_s, now_s + _RETRY_S)))

    def stop(self) -> None:
        """Ask `run` to return. May be called from a signal handler."""
        with self._lock:
            self._stopping = True
            self._timer.notify_all()
        self._wakes.put(None)

    def close(self) -> bool:
        """Send a last safe stop and end the policy's thread; False where that thread hangs."""
        self.stop()
        self._board.close()
        if self._worker.is_alive():
            self._worker.join(_JOIN_S)
        with self._lock:
            self._send(self._controller.farewell())
        return not self._worker.is_alive()

    def has_heard(self) -> bool:
        return bool(self._latest.accepted or self._latest.rejected)

    def health(self) -> Health:
        with self._lock:
            safety = self._controller.safety
            return Health(
                vehicle_id=self._link.vehicle_id,
                vehicle=self._vehicle.name if self._vehicle else "none",
                mode=safety.mode.value,
                reason=safety.reason,
                needs_rearm=self._controller.waits_for_rearm,
                accepted=self._latest.accepted,
                superseded=self._superseded,
                rejected=dict(self._latest.rejected),
                deadline_misses=self._controller.deadline_misses,
                safe_stops=safety.safe_stops,
                policy_id=self._policy.policy_id,
                inference_ms=quantiles_ms(self._inferences_ns),
                command_ms=quantiles_ms(self._commands_ns),
                uptime_s=time.monotonic() - self._started_s,
                sent_ns=time.time_ns(),
                rivals=self._link.rivals,
                vehicle_fault=self._controller.vehicle_words[:MAX_TEXT_CHARS],
                **self._board.last._asdict(),
                link=self._link_quality.measured(),
                **self._bounds(),
            )

    def _bounds(self) -> Dict[str, Any]:
        if self._vehicle is None:
            return {}
        bounds = {**self._vehicle.allowed._asdict(), "leash_left_m": self._vehicle.leash.left_m}
        return {name: value if value < math.inf else None for name, value in bounds.items()}

    def _on_state(self, payload: bytes) -> None:
        arrived_s, arrived_ns = time.monotonic(), time.time_ns()
        state = self._link.refusal(arrived_ns / 1e9) or self._policy.layout.decode(payload)
        with self._lock:
            if isinstance(state, Rejection):
                self._log_rejection(self._latest.reject(state), arrived_s)
                return
            rejection = self._latest.offer(state, arrived_s)
            if rejection is not None:
                self._log_rejection(rejection, arrived_s)
                return
            self._link_quality.note_state(state, arrived_ns)
            before = self._slot
            is_waiting = before is not None
            self._superseded += int(is_waiting)
            ended = before is not None and (before.state.final or before.follows_final)
            self._slot = Received(state, arrived_s, arrived_ns, ended)
        if not is_waiting:
            self._wakes.put(None)

    def _work(self) -> None:
        try:
            while self._answer_next():
                pass
        except BaseException:  # whatever it is, the watchdog must know
            with self._lock:
                self._busy_since_s = None
                self._controller.policy_died()
                self._timer.notify()
            log.event("error", "policy_thread_dead", detail=traceback.format_exc())

    def _answer_next(self) -> bool:
        """Wait for a state and answer it; False once the loop is stopped."""
        self._wakes.get()
        with self._lock:
            if self._stopping or self._slot is None:
                return False
            received, self._slot = self._slot, None
            self._busy_since_s = time.monotonic()
            self._controller.begin(received, self._busy_since_s)
        layout, output, inference_ns = self._policy.layout, None, 0
        # The observation of a foreign task was not checked against the layout.
        if not is_foreign(received.state, layout.task_text):
            observation = layout.arrays(received.state.observation)
            output, inference_ns = infer(self._policy, observation)
        with self._lock:
            self._busy_since_s = None
            if self._stopping:
                return False  # `close` sends the last command
            self._inferences_ns.append(inference_ns)
            self._look_at_vehicle(time.monotonic())
            order = self._controller.finish(output, inference_ns, time.monotonic())
            self._send(order)
            if order is not None:
                self._commands_ns.append(int((time.monotonic() - received.arrived_s) * 1e9))
        return True

    def _is_hung(self, now_s: float) -> bool:
        """Return whether policy or driver hangs or lost its thread: a new process may help."""
        driver_s = self._vehicle.busy_s(now_s) if self._vehicle is not None else 0.0
        policy_s = now_s - self._busy_since_s if self._busy_since_s is not None else 0.0
        return not self._worker.is_alive() or max(driver_s, policy_s) > _HUNG_S

    def _look_at_vehicle(self, now_s: float) -> None:
        fault = self._vehicle.fault(now_s) if self._vehicle is not None else ""
        if fault != self._controller.vehicle_fault:
            log.event("warning" if fault else "info", "vehicle", fault=fault)
            self._controller.vehicle_fault = fault
        if self._vehicle is not None:
            self._controller.leash_is_used = self._vehicle.leash_is_used

    def _wake_watchdog(self) -> None:
        with self._lock:
            self._timer.notify()

    def _rearm(self, stop: str = "") -> str:
        with self._lock:
            now_s = time.monotonic()
            if self._vehicle is not None:
                # `enable` ends a fault whose cause has passed, so only a standing one counts.
                self._controller.vehicle_fault = self._vehicle.standing_fault(now_s)
            refusal = self._controller.rearm(now_s, stop)
            if not refusal and self._vehicle is not None:
                self._vehicle.enable()
            log.event("info", "rearm", accepted=not refusal, detail=refusal)
            return refusal

    def _sleep(self, until_s: float) -> None:
        """Wait for the next deadline; holds the lock before and after."""
        due_s = self._controller.next_deadline_s()
        if due_s is not None:
            until_s = min(until_s, due_s)
        if self._vehicle is not None and not self._controller.vehicle_fault:
            until_s = min(until_s, self._vehicle.silent_at_s)
        # At most T, the limit of an inference: so its start need not wake this thread.
        pause_s = min(until_s - time.monotonic(), self._period_s)
        if pause_s > 0:
            self._timer.wait(pause_s)

    def _send(self, order: Optional[Order]) -> None:
        self._log_transition()
        if order is None:
            return
        command = order.command(self._policy.policy_id, time.time_ns())
        if not order.ridden:
            self._link.send("command", command)
            self._link_quality.note_command(command.episode, command.sent_ns)
        if self._vehicle is not None:
            # No latch at the end of an episode, if the next one needs no re-arm; and none for a
            # stop that is repeated between a re-arm and the first fresh state: it would undo the
            # re-arm.
            unlatched = order.reason == Event.FINAL.value and not self._controller.each_episode
            unlatched = unlatched or self._controller.safety.rearmed
            self._vehicle.command(command, order.answers.state.speed_mps, latch=not unlatched)

    def _log_transition(self) -> None:
        safety, waits = self._controller.safety, self._controller.waits_for_rearm
        was_mode, was_reason, waited = self._logged
        if (safety.mode, safety.reason) != (was_mode, was_reason):
            level, now = "warning" if safety.mode is Mode.SAFE_STOP else "info", safety.mode.value
            log.event(level, "mode", was=was_mode.value, now=now, reason=safety.reason)
            self._notifier.tell(f"STATUS={now} {safety.reason}".rstrip())
        if waits and not waited:
            fields = {"after": safety.reason, "command": self._rearm_command}
            log.event("warning", "waits_for_rearm", **fields)
        self._logged = (safety.mode, safety.reason, waits)

    def _log_link(self, link: Dict[str, float]) -> None:
        if (poor := is_poor(link, self._period_s, self._is_poor)) is not self._is_poor:
            self._is_poor = poor
            log.event("warning" if poor else "info", "link", poor=poor, measured=link_words(link))

    def _log_rejection(self, rejection: Rejection, now_s: float) -> None:
        """Log one rejection a second of each reason; health counts all of them."""
        reason = rejection.reason.value
        if now_s >= self._logged_rejection_s.get(reason, -math.inf) + _FLOOD_PERIOD_S:
            self._logged_rejection_s[reason] = now_s
            so_far = self._latest.rejected[reason]
            log.event("warning", "rejected", reason=reason, detail=rejection.detail, so_far=so_far)
