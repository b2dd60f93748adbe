"""Recorded states through a policy in this process, with the runtime's own decision logic.

Time comes from the recording alone, so that two replays of one file are the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bridge.replaying.recorded import (
    JUST_AFTER_S,
    Answer,
    Key,
    RecordedDrive,
    RecordedState,
    key_of,
)
from edge_runtime.config import NONE, Config
from edge_runtime.controller import Controller, LimitRow, Order, Received, limit_rows
from edge_runtime.policy import Policy, infer
from edge_runtime.safety import Event
from edge_runtime.vehicles.registry import vehicle_limits

Answers = dict[Key, list[Answer]]


def replay_in_process(drive: RecordedDrive, policy: Policy, config: Config) -> Answers:
    """Return the answers to every state that was answered in the recording.

    Which vehicle was attached is the recording's, and so is what befell it: when it failed, when
    an operator re-armed (before a state that was answered with ``drive``), and when the runtime
    was started anew. Its limits follow from ``config``. UserError where it lacks an action of the
    policy or cannot follow its scenario.
    """
    limits = vehicle_limits(drive.vehicle, config.vehicle_setup(policy.manifest.scenario))
    rows = limit_rows(policy.manifest.action, limits)
    return _Replay(drive, policy, rows, needs_rearm=drive.vehicle != NONE).run()


class _Replay:
    def __init__(
        self, drive: RecordedDrive, policy: Policy, rows: Sequence[LimitRow], needs_rearm: bool
    ) -> None:
        self._drive = drive
        self._policy = policy
        self._rows = rows
        self._needs_rearm = needs_rearm
        self._restarts_s: Iterator[float] = iter(drive.runtime_starts_s[1:])
        self._next_restart_s = next(self._restarts_s, float("inf"))
        self._controller = self._make_controller()
        self._last_heard_s = 0.0
        self._answers: Answers = {}

    def run(self) -> Answers:
        for recorded in self._drive.answered():
            self._restart(recorded.exchange.arrived_s)
            self._answer(recorded)
        self._pass_time(self._last_heard_s)
        return self._answers

    def _restart(self, now_s: float) -> None:
        while now_s >= self._next_restart_s:
            self._pass_time(self._last_heard_s)
            self._controller = self._make_controller()
            self._next_restart_s = next(self._restarts_s, float("inf"))

    def _make_controller(self) -> Controller:
        return Controller(self._rows, self._needs_rearm, task=self._policy.manifest.task)

    def _answer(self, recorded: RecordedState) -> None:
        state, exchange = recorded
        self._pass_time(exchange.begun_s)
        rearmed = any(answer.mode == "drive" for answer in exchange.answers)
        if rearmed and self._controller.waits_for_rearm:
            self._controller.rearm(exchange.arrived_s)
        arrived_ns = round(exchange.arrived_s * 1e9)
        self._controller.begin(Received(state, exchange.arrived_s, arrived_ns), exchange.begun_s)
        output = infer(self._policy, state.frames_array()).output
        self._pass_time(exchange.finished_s)
        first, *later = exchange.answers
        self._controller.vehicle_fault = self._new_fault([first])
        self._note(self._controller.finish(output, 1, exchange.finished_s))
        self._controller.vehicle_fault = self._new_fault(later)
        if self._controller.vehicle_fault:
            self._note(self._controller.tick(exchange.finished_s))
            self._controller.vehicle_fault = ""
        self._last_heard_s = exchange.last_s

    def _new_fault(self, answers: Sequence[Answer]) -> str:
        """The vehicle's fault where these answers are the first to tell of it; else empty.

        How long the cause stood is not recorded, and need not be: the stop is latched.
        """
        fault = Event.VEHICLE.value
        told = any(answer.reason == fault for answer in answers)
        return fault if told and self._controller.safety.reason != fault else ""

    def _pass_time(self, until_s: float) -> None:
        """Be the watchdog up to a moment."""
        last_s = None
        while (due_s := self._controller.next_deadline_s()) is not None and due_s != last_s:
            if due_s + JUST_AFTER_S > until_s:
                return
            self._note(self._controller.tick(due_s + JUST_AFTER_S))
            last_s = due_s

    def _note(self, order: Order | None) -> None:
        if order is None:
            return
        answers = self._answers.setdefault(key_of(order.answers.state), [])
        answer = Answer(order.mode, order.reason, tuple(order.action))
        if not answers or answers[-1] != answer:
            answers.append(answer)
