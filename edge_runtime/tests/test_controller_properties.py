"""Any history of states, silences, answers and permissions against what the contract forbids.

The test keeps its own few facts (the last fault, the states since, the last permission) and never
looks at the table: a command to drive is held against the facts alone.
"""

import math
from functools import partial
from typing import Any, Optional

import msgspec
import numpy as np
import pytest
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import PEDAL, STEERING
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from edge_runtime.controller import (
    ActionLimit,
    Controller,
    ControllerConfig,
    Order,
    Received,
    shared_limits,
)

T = 0.1
SILENT_S = 2 * T + 0.02  # a grace within the contract's 50 ms
LONGEST_PAUSE_S = 10.0
JUST_AFTER_S = 1e-6
SLOW = {"pedal": ActionLimit(-1.0, 0.5, 2.0), "steering": ActionLimit(-0.4, 0.4, 1.0)}

gaps = st.sampled_from([0.001, 0.05, T, T, T, 0.19, 0.2, 0.21, 0.23, 0.6, 0.71, 1.0, 9.0, 11.0])
durations = st.sampled_from([0.001, 0.001, 0.001, 0.06, 0.099, 0.101, 0.5])
waits = st.sampled_from([0.0, 0.0, 0.0, 0.05, 0.3])
numbers = st.one_of(st.floats(-3, 3), st.sampled_from([0.0, 0.0, math.nan, math.inf, -math.inf]))
outputs = st.one_of(
    st.lists(numbers, min_size=2, max_size=2),
    st.sampled_from([[], [0.5], [0.5, 0.1, 0.0], [[0.5, 0.1]], 0.5]),
)


class AnyHistory(RuleBasedStateMachine):
    def __init__(
        self, vehicle: bool, armed_at_start: bool, ride_s: float, each_episode: bool
    ) -> None:
        super().__init__()
        self.vehicle = vehicle
        self.limits = shared_limits([PEDAL, STEERING], SLOW if vehicle else {})
        self.controller = Controller(
            ControllerConfig(
                self.limits, T, vehicle, armed_at_start, ride_s=ride_s, each_episode=each_episode
            )
        )
        self.ride_s = ride_s
        self.each_episode = vehicle and each_episode
        self.episode = 0
        self.ended = False  # the next state begins an episode, whatever its number
        self.leash_is_used = False
        self.answered_s = -math.inf  # the last order that was no ridden one
        self.now_s = 100.0
        self.step = 0
        self.session = 0
        self.arrived_s: Optional[float] = None
        self.good_in_a_row = 0
        self.permitted = armed_at_start
        self.last: Optional[Order] = None
        self.last_s = -math.inf
        self.stop_s: Optional[float] = None  # the last safe stop, while the watchdog is on time

    @rule(count=st.integers(1, 7), gap_s=gaps, final=st.booleans(), late=st.booleans())
    def good_states(self, count, gap_s, final, late):
        for left in reversed(range(count)):
            self._state([0.5, 0.1], gap_s, late=late, final=final and left == 0)

    @rule(count=st.integers(3, 7), gap_s=st.sampled_from([0.05, T]))
    def it_is_re_armed_and_states_come(self, count, gap_s):
        """Chance alone hardly ever lets a vehicle drive again after a stop."""
        self._state([0.5, 0.1], gap_s)
        self.the_operator_permits()
        self.good_states(count, gap_s, final=False, late=False)

    @rule(how=st.fixed_dictionaries({
        "output": outputs, "gap_s": gaps, "wait_s": waits, "duration_s": durations,
        "final": st.booleans(), "late": st.booleans(),
    }))  # fmt: skip
    def any_state(self, how):
        self._state(**how)

    @rule(gap_s=gaps)
    def another_simulator(self, gap_s):
        self._pass(max(gap_s, SILENT_S), late=False)
        self.session += 1
        self._fault()
        self.permitted = self.permitted and self.arrived_s is None
        self._state([0.5, 0.1], 0.0)

    @rule(gap_s=gaps, says_so=st.booleans())
    def another_episode(self, gap_s, says_so):
        """With a final state before it, or without; with a number of its own, or the last one."""
        if says_so:
            self._state([0.5, 0.1], T, final=True)
        else:
            self.episode, self.ended = self.episode + 1, True
        self._state([0.5, 0.1], gap_s)

    @rule()
    def the_leash_is_used(self):
        if self.vehicle:
            drove = self._drives()
            self.controller.leash_is_used = self.leash_is_used = True
            order = self.controller.tick(self.now_s)
            assert not drove or (order is not None and order.reason == "leash")
            self.good_in_a_row, self.permitted = 0, False
            if order is not None:
                self._note(order)

    @rule(duration_s=st.sampled_from([0.05, 0.25, 2.0, 12.0]))
    def nothing_comes(self, duration_s):
        self._pass(duration_s, late=False)

    @rule()
    def the_vehicle_fails(self):
        """In whatever moment: it stops with the next look, and needs the operator."""
        if self.vehicle:
            drove = self._drives()
            self.controller.vehicle_fault = "it is stuck"
            order = self.controller.tick(self.now_s)
            self.controller.vehicle_fault = ""
            assert not drove or (order is not None and order.reason == "vehicle_fault")
            self.good_in_a_row, self.permitted = 0, False
            if order is not None:
                self._note(order)

    @rule()
    def the_operator_permits(self):
        if self.controller.rearm(self.now_s) == "":
            assert self.vehicle
            assert self.arrived_s is not None
            assert self.now_s - self.arrived_s <= SILENT_S
            self.permitted, self.leash_is_used = True, False
            assert not self.controller.leash_is_used

    def _state(self, output, gap_s, wait_s=0.0, duration_s=0.001, final=False, late=False):
        """A state comes after `gap_s`, waits for the policy, and is answered."""
        self._pass(gap_s, late)
        pause_s = 0.0 if self.arrived_s is None else self.now_s - self.arrived_s
        if pause_s > self._patience_s():
            self._fault()
        if pause_s > LONGEST_PAUSE_S:
            self.permitted = False
        if self.each_episode and self.ended and self.arrived_s is not None:
            self._fault()
            self.permitted = False
        self.ended = final
        self.arrived_s = self.now_s
        self.step += 1
        sent = {"sent_ns": int(self.now_s * 1e9)}  # No link holds it up.
        state = make_state(self.step, session=f"s{self.session}", final=final, **sent)
        state = msgspec.structs.replace(state, episode=self.episode)
        received = Received(state, self.now_s, 0)
        self._pass(wait_s, late)
        self.controller.begin(received, self.now_s)
        self._pass(duration_s, late)
        in_time = duration_s <= T and self.now_s - received.arrived_s <= SILENT_S
        answer = np.array(output, np.float32)
        if (
            in_time
            and not self.leash_is_used
            and answer.shape == (2,)
            and np.all(np.isfinite(answer))
        ):
            self.good_in_a_row += 1
        else:
            self._fault()
        order = self.controller.finish(answer, int(duration_s * 1e9), self.now_s)
        if order is not None:
            self._note(order)

    def _fault(self) -> None:
        """What happened starts the count again, and takes back a permission not yet used."""
        self.good_in_a_row = 0
        if self._is_stopped():
            self.permitted = False

    def _drives(self) -> bool:
        last = self.last
        return last is not None and last.mode == "drive" and not last.answers.state.final

    def _patience_s(self) -> float:
        return SILENT_S + (self.ride_s if self._drives() else 0.0)

    def _is_stopped(self) -> bool:
        return self.last is not None and self.last.mode == "safe_stop"

    def _pass(self, duration_s: float, late: bool) -> None:
        """Let time go by with a watchdog on time, or one that gets no processor."""
        end_s = self.now_s + duration_s
        if late:
            self.stop_s = None
            self.now_s = end_s
            return
        while True:
            due_s = self.controller.next_deadline_s()
            if due_s is None or due_s + JUST_AFTER_S > end_s:
                break
            self.now_s = max(self.now_s, due_s + JUST_AFTER_S)
            order = self.controller.tick(self.now_s)
            if order is not None:
                assert (order.mode == "safe_stop") != order.ridden
                if self.stop_s is not None and order.reason != "inference_too_long":
                    assert self.now_s - self.stop_s == pytest.approx(T, abs=1e-4)
                self._note(order)
        self.now_s = end_s
        if self._drives():
            assert self.arrived_s is not None
            assert self.now_s - self.arrived_s <= self._patience_s() + 2 * JUST_AFTER_S

    def _note(self, order: Order) -> None:
        if order.mode == "drive":
            assert not (self.vehicle and order.answers.state.final)
            self._check_drive(order)
        elif order.reason == "final_state":  # the vehicle stands, and nothing has gone wrong
            assert self.vehicle
            assert not self._is_stopped()
            assert order.action[0] == self.limits["pedal"].low
            order = order._replace(mode="standby")
        else:
            assert order.mode == "safe_stop"
            assert order.reason
            assert order.action[0] == self.limits["pedal"].low
            if self.stop_s is not None:
                assert self.now_s - self.stop_s <= T + 1e-4
            self.permitted = self.permitted and self._is_stopped()
        for value, row in zip(order.action, self.limits.values()):
            assert row.low <= value <= row.high
        self.last, self.last_s = order, self.now_s
        self.answered_s = self.answered_s if order.ridden else self.now_s
        self.stop_s = self.now_s if self._is_stopped() else None

    def _check_drive(self, order: Order) -> None:
        if order.ridden:  # by what drives, for a vehicle, after T, and no longer than it may
            assert self.vehicle
            assert self._drives()
            assert order.plan is msgspec.UNSET
            assert T < self.now_s - self.answered_s <= self.ride_s + 0.2 * T + 1e-4
        elif self.ride_s and not order.answers.state.final:
            plan = order.plan or []
            assert len(plan) == 5
            for action in plan:
                for value, row in zip(action, self.limits.values()):
                    assert row.low <= value <= row.high
        assert order.ridden or self.good_in_a_row >= (5 if self._is_stopped() else 1)
        assert self.permitted or not self.vehicle
        assert order.reason == ""
        ridden_s = self.ride_s if order.ridden else 0.0
        assert self.now_s - order.answers.arrived_s <= SILENT_S + ridden_s
        before = self.last.action if self.last else [0.0, 0.0]
        since_s = self.now_s - self.last_s
        for value, last, row in zip(order.action, before, self.limits.values()):
            assert math.isfinite(value)
            if row.slew_per_s < math.inf:
                assert abs(value - last) <= row.slew_per_s * min(since_s, T) + 1e-9


@pytest.mark.parametrize("ride_s", [0.0, 0.5])
@pytest.mark.parametrize(
    ("vehicle", "armed_at_start", "each_episode"),
    [(False, True, True), (True, True, False), (True, True, True), (True, False, True)],
)
def test_any_history(vehicle, armed_at_start, each_episode, ride_s):
    patient = settings(max_examples=24, stateful_step_count=30)
    make: Any = partial(AnyHistory, vehicle, armed_at_start, ride_s, each_episode)
    run_state_machine_as_test(make, settings=patient)
