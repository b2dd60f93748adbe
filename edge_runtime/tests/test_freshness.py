"""Which state is too late: by hand, then any story of a link, a clock and a vehicle."""

import heapq
import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import PEDAL
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.controller import Controller, ControllerConfig, Received, shared_limits
from edge_runtime.latest import DRIFT, Freshness
from edge_runtime.vehicles.mock import MockVehicle

T = 0.1
LIMIT_S = 2.2 * T
DECADES_S = 1.7e9
GOOD = np.array([0.5], np.float32)


def lags(*states, limit_s=LIMIT_S, trips=None, stands=()):
    """The lag of each (sent, arrived); `trips` and `stands` by number."""
    freshness, trips = Freshness(limit_s), trips or {}
    return [
        freshness.lag_s("a", sent_s, arrived_s, trips.get(n), n in stands)
        for n, (sent_s, arrived_s) in enumerate(states)
    ]


def near(*lags_s):
    return pytest.approx(lags_s, abs=3e-3)  # the least may have crept


def test_a_lag_is_what_a_state_has_above_the_quickest_of_its_session():
    assert lags((5.0, 10.0), (5.1, 10.15), (5.2, 10.19), (5.3, 10.6)) == near(0, 0.05, 0, 0.31)
    # Whatever the pace: a backlog that comes in step is as late as one that comes at once.
    assert lags((0.0, 0.0), *((T * n, T * n + 3.0) for n in (1, 2, 3)))[1:] == near(3, 3, 3)


def test_a_quicker_state_is_the_new_measure_and_is_not_late_itself():
    # Of a sender that does not say what it heard.
    assert lags((0.0, 3.0), (3.1, 3.1), (3.2, 6.2)) == near(0, 0, 3)
    # Of one that does, while it stands.
    states, trips = [(0.0, 0.2), (T, 0.2), (2 * T, 0.4)], {0: 0.25, 1: 0.15}
    assert lags(*states, trips=trips, stands={1}) == near(0, 0, 0.1)


def test_clocks_that_drift_are_followed_and_each_session_has_its_own_quickest_state():
    drifting = [(s, s * (1 + DRIFT)) for s in range(0, 3601, 60)]
    assert max(lags(*drifting)) == 0.0
    assert lags((0.0, 0.0), (100.0, 100.3)) == near(0, 0.28)
    # The quickest trip creeps, too: one clock reads more of it by then.
    assert lags((0.0, 0.0), (1e3, 1e3), trips={0: 0.05, 1: 0.25}, stands={1}) == near(0, 0)
    freshness = Freshness(LIMIT_S)
    states = (("a", 0.0, 0.0), ("b", 500.0, 0.1), ("a", 0.2, 2.0))
    assert [freshness.lag_s(*state, None, False) for state in states] == near(0, 0, 1.8)


def test_a_clock_that_is_set_counts_as_lag_until_the_round_trip_of_a_stop_shows_no_backlog():
    trips = dict.fromkeys(range(9), 0.05)
    back = [(0.0, 0.0), (T, T), (-9.8, 0.2), (-9.7, 0.3), (-9.6, 0.4)]
    assert lags(*back, trips=trips)[2:] == near(10, 10, 10)
    assert lags(*back, trips=trips, stands={3})[2:] == near(10, 0, 0)
    assert lags(*back, trips={**trips, 3: 2.0}, stands={3})[2:] == near(10, 1.95, 1.95)
    assert lags(*back, stands={3})[2:] == near(
        10, 10, 10
    )  # a sender that does not say what it heard
    ahead = [(0.0, 0.0), (T, T), (9.2, 0.2), (9.3, 0.3)]
    assert lags(*ahead, trips=trips)[2:] == near(9, 9)
    assert lags(*ahead, trips={**trips, 2: -1.0}, stands={2, 3})[2:] == near(9, 0)
    # In the stop itself: the trip alone tells, all of what it has above the quickest.
    assert lags(*ahead[:3], trips={**trips, 2: 0.35}, stands={2})[2:] == near(0.3)
    # No clock was set where a state is somewhat quicker, whatever the two clocks' offset.
    quicker = [(0.0, 0.05), (T, 0.05)]
    assert lags(*quicker, trips={0: 0.2, 1: 0.35}, stands={1}) == near(0, 0)


def test_a_round_trip_is_held_against_the_quickest_whose_state_did_not_lag():
    back = [(0.0, 0.0), (T, 0.3), (-9.8, 0.4), (-9.7, 0.5)]
    assert lags(*back, trips={1: 0.25, 3: 0.25}, stands={2, 3})[2:] == near(10.2, 0.2)
    # The first trip is the quickest, however quick or late its state was.
    early = [(0.0, 0.2), (T, 0.2), (2 * T, 0.3)]
    assert lags(*early, trips={1: 0.3, 2: 0.75}, stands={2})[2:] == near(0.45 - LIMIT_S)
    late = [(0.0, 0.0), (T, 0.3), (2 * T, 0.2)]
    assert lags(*late, trips={1: 0.1, 2: 0.5}, stands={2})[2:] == near(0.5 - LIMIT_S)
    # What is measured only while a clock may have been set shows nothing.
    assert lags(*back, trips={2: 2.0, 3: 2.0}, stands={3})[2:] == near(10.2, 10.2)


def test_a_final_state_that_comes_past_the_injected_network_teaches_nothing():
    freshness = Freshness(LIMIT_S)
    states = [
        (0.0, 0.2, 0.4, False, False),
        (T, T, 0.2, False, True),
        (1.0, 1.3, 0.5, False, False),
        (9.0, 9.25, 0.45, True, False),
        (9.0, 9.5, None, False, True),
    ]
    assert [freshness.lag_s("a", *state) for state in states] == near(0, 0, 0.1, 0.05, 0.3)


def test_a_state_that_gets_too_late_while_the_policy_computes_is_left_out_and_ends_no_silence():
    controller = Controller(ControllerConfig(shared_limits([PEDAL], {}), T))
    seen = []
    for step, delay_s in enumerate([0.0, 0.1, 0.2, 0.215, 0.215, 0.215]):
        now_s = 1000.0 + step * T + delay_s
        state = make_state(step, sent_ns=round((DECADES_S + step * T) * 1e9))
        controller.begin(Received(state, now_s, 0), now_s)
        order = controller.finish(GOOD, 1, now_s + 0.01)
        seen.append(order.mode if order else "")
    assert seen == ["drive", "drive", "drive", "", "", "safe_stop"]
    assert controller.safety.reason == "state_late"


def test_commands_that_are_late_in_a_stop_do_not_make_a_state_late():
    states, stands = [(T * n, T * n) for n in range(4)], {2, 3}
    trips = {0: 0.05, 1: 0.05, 2: 0.25, 3: 0.25}
    assert lags(*states, trips=trips, stands=stands) == near(0, 0, 0, 0)
    assert lags(*states, trips={**trips, 2: 0.7}, stands=stands) == near(0, 0, 0.65 - LIMIT_S, 0)
    # A lag that was driven on stays one: the least follows it.
    assert lags(*states, trips={**trips, 2: 0.4}, stands={2})[2:] == near(*[0.35 - LIMIT_S] * 2)


def test_the_time_for_which_the_sender_held_a_command_is_no_part_of_its_round_trip():
    heard = {"heard": 1, "heard_sent_ns": 10**9, "heard_ns": 5 * 10**9}
    state = make_state(3, sent_ns=5 * 10**9 + 7 * 10**8, **heard)
    assert Received(state, 0.0, 10**9 + 9 * 10**8).trip_s == pytest.approx(0.2)
    for unknown in ("heard_sent_ns", "heard_ns"):
        said = msgspec.structs.replace(state, **{unknown: None})
        assert Received(said, 0.0, 10**9).trip_s is None


def late_controller(*late):
    """One that has answered a state, and then so many states late by 3 s."""
    controller = Controller(ControllerConfig(shared_limits([PEDAL], {}), T))
    for step, lag_s in enumerate([0.0, *late]):
        answered(controller, step, 1000.0 + T * step, lag_s)
    return controller


def test_a_gap_between_late_states_is_no_news_in_the_stop_that_they_made():
    controller = late_controller(*[3.0] * 4)
    assert controller.safety.reason == "state_late"
    answered(controller, 9, 1005.0, 3.0)
    assert controller.safety.reason == "state_late"


def test_another_sender_is_news_in_a_stop_that_late_states_made():
    controller = Controller(ControllerConfig(shared_limits([PEDAL], MockVehicle.limits), T, True))
    for step, lag_s in enumerate([0.0, 3.0, 3.0, 3.0, 3.0]):
        answered(controller, step, 1000.0 + T * step, lag_s)
    state = make_state(0, sent_ns=round((1000.8 + DECADES_S) * 1e9), session="another")
    controller.begin(Received(state, 1000.8, 0), 1000.8)
    assert controller.safety.reason == "other_session"


@pytest.mark.parametrize(("late", "mode"), [([], "standby"), ([3.0] * 4, "safe_stop")])
def test_a_late_final_state_ends_a_drive_and_no_stop(late, mode):
    controller = late_controller(*late)
    now_s = 1000.0 + T * (1 + len(late))
    state = make_state(9, sent_ns=round((now_s - 3.0 + DECADES_S) * 1e9), final=True)
    controller.begin(Received(state, now_s, 0), now_s)
    controller.finish(GOOD, 1, now_s)
    assert controller.safety.mode.value == mode


def answered(controller, step, now_s, lag_s=0.0, output=GOOD):
    state = make_state(step, sent_ns=round((now_s - lag_s + DECADES_S) * 1e9))
    controller.begin(Received(state, now_s, 0), now_s)
    return controller.finish(output, 1, now_s)


def test_no_permission_that_was_given_beside_a_late_state_outlasts_a_silence():
    controller = Controller(ControllerConfig(shared_limits([PEDAL], MockVehicle.limits), T, True))
    for step, lag_s in enumerate([0.0, 3.0, 3.0, 3.0, 0.0, 3.0]):
        answered(controller, step, 1000.0 + T * step, lag_s)
    assert controller.rearm(1000.51)
    modes = [answered(controller, step, 1005.0 + T * step).mode for step in range(6, 20)]
    assert set(modes) == {"safe_stop"}


@pytest.mark.parametrize(("fault", "output"), [("estop", GOOD), ("", GOOD * np.float32(np.nan))])
def test_what_else_stops_it_is_the_reason_while_states_are_late(fault, output):
    controller = Controller(ControllerConfig(shared_limits([PEDAL], MockVehicle.limits), T, True))
    answered(controller, 0, 1000.0)
    controller.vehicle_fault = fault
    reasons = []
    for step in range(9):
        controller.tick(1000.95 + T * step)
        reasons.append(controller.safety.reason)
        reasons.append(answered(controller, step, 1001.0 + T * step, 3.0, output).reason)
    assert len(set(reasons[1:])) == 1


@pytest.mark.parametrize(
    ("period_s", "delay_s", "jitter_s"), [(0.1, 0.15, 0.05), (0.02, 0.05, 0.01)]
)
def test_jitter_both_ways_does_not_keep_it_in_a_stop(period_s, delay_s, jitter_s):
    rng, drives = np.random.default_rng(7), 0
    controller = Controller(ControllerConfig(shared_limits([PEDAL], {}), period_s))
    for step in range(1000):
        up_s, down_s = rng.normal(delay_s, jitter_s, 2).clip(0.001)
        sent_s = 1000.0 + step * period_s
        now_s, sent_ns = sent_s + up_s, round((DECADES_S + sent_s) * 1e9)
        heard = {"heard": 0, "heard_ns": sent_ns, "heard_sent_ns": round((sent_s - down_s) * 1e9)}
        state = make_state(step, sent_ns=sent_ns, **heard)
        controller.begin(Received(state, now_s, round(now_s * 1e9)), now_s)
        # A policy that fails stops it.
        order = controller.finish(GOOD if step % 200 else None, 1, now_s)
        drives += order is not None and order.mode == "drive"
    assert drives > 700


class World:
    """A sender each T, a link in either direction that keeps the order, and a controller."""

    def __init__(self, vehicle: bool, ride_s: float, down_s: float = 0.05) -> None:
        limits = shared_limits([PEDAL], MockVehicle.limits if vehicle else {})
        self.controller = Controller(ControllerConfig(limits, T, vehicle, ride_s=ride_s))
        self.vehicle, self.ride_s = vehicle, ride_s
        self.now_s, self.step, self.clock_s = 1000.0, 0, 0.0
        self.up_s, self.down_s = 0.01, down_s
        self.up_free_s = self.down_free_s = 0.0
        self.heard: dict = {}
        self.heard_s = self.stepped_s = -math.inf
        self.least_s = math.inf  # of the true delays that a clock's step did not disguise
        self.hidden_s = 0.0  # by steps ahead since a round trip in a stop
        self.permitted = True
        self.measured = self.stopped = False
        self.drives = 0
        self.events: list = []
        self.numbers = itertools.count()

    def lives(self, periods, up_s, growth_s, step_s, lost, fault, rearms, ends):
        """So many control periods of one kind; the delay grows with each state."""
        self.up_s = up_s
        self.clock_s += step_s
        self.hidden_s += max(step_s, 0.0)
        self.stepped_s = self.now_s if step_s else self.stepped_s
        self.controller.vehicle_fault = "it is stuck" if fault else ""
        for _ in range(periods):
            self.up_s += growth_s
            self.send(lost)
            if rearms and self.controller.rearm(self.now_s) == "":
                self.permitted = True
            self.run_until(self.now_s + T)
        if ends:
            self.send(False, final=True)

    def send(self, lost, final=False):
        sent_ns = round((self.now_s + self.clock_s + DECADES_S) * 1e9)
        state = make_state(self.step, sent_ns=sent_ns, final=final, **self.heard)
        self.step += 1
        if final:  # past the network
            self.arrive(state, self.now_s, self.heard_s)
        elif not lost:
            self.up_free_s = max(self.up_free_s, self.now_s + self.up_s)
            self.push(self.up_free_s, ("state", state, (self.now_s, self.heard_s)))

    def push(self, at_s, event):
        heapq.heappush(self.events, (at_s, next(self.numbers), event))

    def run_until(self, end_s):
        while True:
            due_s = self.controller.next_deadline_s()
            due_s = math.inf if due_s is None else max(due_s + 1e-6, self.now_s)
            next_s = self.events[0][0] if self.events else math.inf
            if min(due_s, next_s) > end_s:
                break
            self.now_s = min(due_s, next_s)
            if due_s <= next_s:
                self.note(self.controller.tick(self.now_s))
                continue
            kind, message, when = heapq.heappop(self.events)[2]
            if kind == "state":
                self.arrive(message, *when)
            else:
                self.heard_s = self.now_s
                heard_ns = round((self.now_s + self.clock_s + DECADES_S) * 1e9)
                self.heard = {"heard": 1, "heard_sent_ns": message, "heard_ns": heard_ns}
        self.now_s = end_s

    def arrive(self, state, sent_s, heard_s):
        delay_s = self.now_s - sent_s
        if heard_s >= self.stepped_s and not state.final:
            self.least_s = min(self.least_s, delay_s)
        self.late_s = delay_s - self.least_s
        # A round trip shows a backlog where one without it was measured before.
        self.measured |= (
            not state.final and heard_s > 0.0 > self.stepped_s and self.late_s < LIMIT_S
        )
        if self.stopped and self.measured and heard_s > self.stepped_s:
            self.hidden_s = min(self.hidden_s, LIMIT_S)
        received = Received(state, self.now_s, round(self.now_s * 1e9))
        self.controller.begin(received, self.now_s)
        self.now_s += 0.001
        self.note(self.controller.finish(GOOD, 1_000_000, self.now_s))

    def note(self, order: Any) -> None:
        if order is None:
            return
        if order.ridden:
            assert self.vehicle
            assert not self.stopped
            age_s = self.now_s - order.answers.arrived_s
            assert age_s <= LIMIT_S + self.ride_s + 1e-3
        elif order.mode == "drive":
            allowed_s = LIMIT_S + DRIFT * (self.now_s - 1000.0) + self.hidden_s
            assert self.late_s <= allowed_s + 1e-6
            assert self.permitted or not self.vehicle
            self.stopped = False
            self.drives += 1
        elif order.reason != "final_state":
            self.permitted = self.permitted and self.stopped
            self.stopped = True
        if not order.ridden:
            self.down_free_s = max(self.down_free_s, self.now_s + self.down_s)
            self.push(self.down_free_s, ("command", round(self.now_s * 1e9), 0.0))


delays = st.sampled_from([0.01, 0.01, 0.05, 0.2, 0.31, 0.6, 3.0])
kinds_of_life = st.fixed_dictionaries({
    "periods": st.sampled_from([1, 3, 8, 20]), "up_s": delays,
    "growth_s": st.sampled_from([0.0, 0.0, 0.0, 0.005, 0.05, 0.3]),
    "step_s": st.sampled_from([0.0] * 5 + [-0.15, -0.5, -3600.0, 0.15, 0.5, 3600.0]),
    "lost": st.booleans(), "fault": st.booleans(), "rearms": st.booleans(),
    "ends": st.booleans(),
})  # fmt: skip


@settings(max_examples=500)
@given(st.booleans(), st.sampled_from([0.0, 0.5]), delays, st.lists(kinds_of_life, max_size=6))
def test_no_story_drives_on_a_late_state_or_without_a_permission(vehicle, ride_s, down_s, story):
    world = World(vehicle, ride_s, down_s)
    for life in story:
        world.lives(**life)


@pytest.mark.parametrize("step_s", [-3600.0, -0.3, 0.0, 0.3, 3600.0])
@pytest.mark.parametrize("ride_s", [0.0, 0.5])
def test_it_drives_again_after_a_stop_whatever_was_done_to_the_clock(step_s, ride_s):
    world, good = (
        World(True, ride_s),
        {"growth_s": 0.0, "lost": False, "fault": False, "ends": False},
    )
    quick = {"up_s": 0.05, **good}
    world.lives(periods=20, step_s=0.0, rearms=False, **quick)
    assert world.drives > 15
    world.lives(periods=20, step_s=step_s, rearms=False, **quick)
    assert world.stopped == (step_s != 0.0)
    world.lives(periods=20, step_s=0.0, rearms=True, **quick)
    assert not world.stopped
    # A backlog stops it again, and while it lasts no permission helps.
    backlog = {**quick, "up_s": 3.0}
    world.lives(periods=40, step_s=0.0, rearms=True, **backlog)
    assert world.stopped
    world.lives(periods=20, step_s=0.0, rearms=True, **quick)
    world.lives(periods=20, step_s=0.0, rearms=True, **quick)
    assert not world.stopped
