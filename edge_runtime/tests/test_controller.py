"""The controller against made-up times: no clock, no socket, no policy. Then with a vehicle."""

import math

import numpy as np
import pytest
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import PEDAL, STEERING
from msgspec.structs import replace

from edge_runtime.controller import (
    ActionLimit,
    Controller,
    ControllerConfig,
    Received,
    Ride,
    limit_action,
    shared_limits,
)
from edge_runtime.safety import FAULTS, TRANSITIONS, Event, Mode
from edge_runtime.util import UserError

NAN = np.array([np.nan], np.float32)
GOOD = np.array([0.5], np.float32)
QUICK_NS = 1_000_000
T = 0.1
KINDS: dict = {  # of states that come, and how the policy answers them
    "state": {},
    "nan": {"output": NAN},
    "final": {"final": True},
    "of another simulator": {"session": "simulator-b"},
    "of our task": {"task": "ours"},
    "of another task": {"task": "another"},
    "of the same episode": {"episode": 0},
    "of a later episode": {"episode": 7},
    "after a final that was not seen": {"episode": 0, "follows_final": True},
    "final nan of another task": {"task": "another", "final": True, "output": NAN},
}


def make(needs_rearm=False, actions=(PEDAL,), vehicle=None, **options):
    return Controller(
        ControllerConfig(shared_limits(actions, vehicle or {}), T, needs_rearm, **options)
    )


def begin(controller, step, arrived_s, now_s, **changes):
    sent = {"sent_ns": round(arrived_s * 1e9), **changes}
    follows_final = sent.pop("follows_final", False)
    controller.begin(Received(make_state(step, **sent), arrived_s, 0, follows_final), now_s)


def answer(controller, step, now_s, output=GOOD, **changes):
    begin(controller, step, now_s, now_s, **changes)
    return controller.finish(output, QUICK_NS, now_s + 0.001)


def riding(max_s, needs_rearm, vehicle=None):
    limits = shared_limits([PEDAL], vehicle or {})
    return Controller(ControllerConfig(limits, T, needs_rearm, ride_s=max_s))


def test_a_vehicle_is_played_the_plan_until_it_ends_and_then_it_stops():
    controller = riding(0.59, True, {"pedal": ActionLimit(-1.0, 0.4, 1.0)})
    order = answer(controller, 0, 10.0)
    plan = [round(value, 6) for (value,) in order.plan or []]
    assert (order.action, plan) == ([pytest.approx(0.1)], [0.2, 0.3, 0.4, 0.4, 0.4])
    told = []
    while (due_s := controller.next_deadline_s() or 0.0) < 11.0:
        order = controller.tick(due_s + 1e-6)
        assert order is not None
        assert order.inference_ns == 0
        told.append((round(due_s, 3), order.ridden, round(order.action[0], 3), order.reason))
    assert told[:6] == [
        (10.121, True, 0.2, ""), (10.221, True, 0.3, ""), (10.321, True, 0.4, ""),
        (10.421, True, 0.4, ""), (10.521, True, 0.4, ""), (10.72, False, -1.0, "no_fresh_state"),
    ]  # fmt: skip
    assert not any(ridden for _, ridden, _, _ in told[6:])


def test_what_a_link_held_up_is_not_driven_on_and_what_it_lost_is():
    controller = riding(0.5, False)
    for step, (arrived_s, sent_s, driven) in enumerate([
        (10.0, 5.0, True), (10.1, 5.1, True), (10.6, 5.6, True),  # lost: as late as it was sent
        (11.1, 5.7, False), (11.101, 5.8, False), (11.102, 5.9, True), (11.103, 6.0, True),
        (11.104, 6.1, True), (11.2, 6.2, True), (11.3, 2.0, False),  # its clock was set back
        (11.4, 2.1, False), (11.5, 6.5, True),  # and ahead again
    ]):  # fmt: skip
        order = answer(controller, step, arrived_s, sent_ns=round(sent_s * 1e9))
        assert (order is not None) == driven, step
        assert order is None or order.mode == "drive"


@pytest.mark.parametrize(
    ("max_s", "period_s"),
    [*((max_s, T) for max_s in (-1.0, 0.05, 1.1, math.nan, math.inf)), (1.2, 0.3), (0.5, 0.02)],
)
def test_a_ride_is_one_period_to_one_second_at_any_rate(max_s, period_s):
    limits, most_s = shared_limits([PEDAL], {}), 0.2 if period_s == 0.02 else 1
    words = f"use {period_s} to {most_s} s, or 0 for off"  # at most ten periods
    with pytest.raises(UserError, match=f"ride_through.max_s .* {words}"):
        Ride(max_s, period_s, limits, plays=True)
    rides = (1.0, 0.3), (1.0, T), (T, T)
    assert [Ride(*ride, limits, plays=True).periods for ride in rides] == [3, 10, 1]


def said(order):
    """The mode where it drives, the reason of a stop, None where nothing is sent."""
    if order is None:
        return None
    assert (order.mode == "drive") == (order.reason == "")
    if order.mode == "safe_stop":
        assert order.action[0] == -1.0
    return order.reason or order.mode


def play(controller, story):
    """Each row of a story: when, what happens, and what the controller says then."""
    for step, (now_s, what, expected) in enumerate(story):
        if what == "tick":
            found = said(controller.tick(now_s))
        elif what == "next tick":  # so long after it is due
            found = said(controller.tick(controller.next_deadline_s() + now_s))
        elif what == "due":
            found, expected = controller.next_deadline_s(), expected and pytest.approx(expected)
        elif what == "rearm":
            found = controller.rearm(now_s)
            if expected:
                assert expected in found
                continue
        elif what == "fault":
            found = controller.vehicle_fault = expected
        elif what == "leash":
            found = controller.leash_is_used = expected
        elif what == "words":
            found = controller.vehicle_words
        elif what == "dies":
            found = controller.policy_died()
        elif what == "begin":
            found = begin(controller, step, now_s, now_s)
        elif what == "finish":
            found = said(controller.finish(GOOD, QUICK_NS, now_s))
        else:
            episode = sum("final" in earlier for _, earlier, _ in story[:step])
            order = answer(controller, step, now_s, **{"episode": episode, **KINDS[what]})
            assert order.answers.state.step == step
            found = said(order)
        assert found == expected, (step, now_s, what)
    return controller


def states(since_s, count, expected, what="state"):
    """So many states at the control rate, all answered alike."""
    return [(since_s + number * T, what, expected) for number in range(count)]


SILENT, TOO_LONG, DEAD = "no_fresh_state", "inference_too_long", "policy_thread_dead"
FIRST = (0.0, "state", "drive")
STOPPED = [FIRST, (0.3, "tick", SILENT)]


def driving(needs_rearm=False):
    return play(make(needs_rearm), [FIRST])


# Without a vehicle: safe stops and deadline misses in the end, and the rows.
STORIES = {
    "silence stops at two periods and repeats on a grid": (1, 0, [
        FIRST, (0, "due", 0.22), (0.219, "tick", None), (0.221, "tick", SILENT),
        # A late wake-up does not shift those after it.
        *((late_s, "next tick", SILENT) for late_s in (0.0, 0.03, 0.0, 0.05)),
        (0, "due", 0.221 + 0.5),
    ]),
    "no burst after a long pause of the process": (1, 0, [
        FIRST, (0.23, "tick", SILENT), (60.0, "tick", SILENT), (60.05, "tick", None),
        (0, "due", 60.1),
    ]),
    "five fresh states drive again": (1, 0, [
        *STOPPED, *states(1.0, 4, SILENT), *states(1.4, 2, "drive"),
    ]),
    "a gap between fresh states starts the count again without any tick": (1, 0, [
        FIRST, *states(1.0, 4, SILENT), (1.53, "state", SILENT), *states(1.6, 3, SILENT),
        (1.9, "state", "drive"),
    ]),
    # It may take over from 2 T on, within the grace for a lost state, too.
    "no drive goes on with another simulator": (
        1, 0, [FIRST, (0.2, "of another simulator", SILENT)]
    ),
    "a nan stops with the very state and every further one": (
        1, 0, [FIRST, *states(0.1, 8, "output_not_finite", "nan")]
    ),
    "states of another task stop for as long as they come": (1, 0, [
        FIRST,  # an older simulator does not say
        (0.1, "of our task", "drive"), *states(0.2, 7, "other_task", "of another task"),
        (0.9, "final nan of another task", "other_task"),
        *states(1.0, 4, "other_task", "of our task"), (1.4, "of our task", "drive"),
    ]),
    "an inference longer than a period stops while it runs": (1, 1, [
        FIRST, (0.1, "begin", None), (0, "due", 0.2), (0.2, "tick", None),
        (0.201, "tick", TOO_LONG), (1.1, "finish", None),
    ]),
    "a late answer is not used even where no tick came between": (
        1, 1, [(0.0, "begin", None), (0.15, "finish", TOO_LONG)]
    ),
    "exactly one period is in time": (
        0, 0, [(0.0, "begin", None), (0.1, "finish", "drive"), (0.15, "state", "drive")]
    ),
    "between episodes there is no watchdog": (0, 0, [
        (0.0, "final", "drive"), (0, "due", None), (9.0, "tick", None), (10.0, "state", "drive"),
    ]),
    "a pause and another simulator are no fault": (
        0, 0, [(0.0, "final", "drive"), (60.0, "of another simulator", "drive")]
    ),
    "a policy that died before the first state tells nobody and stands": (
        1, 0, [(0, "dies", None), (0.0, "tick", None), (0, "due", None)]
    ),
    "nothing is due before the first state": (0, 0, [(0, "due", None), (100.0, "tick", None)]),
    "an answer without a question is nothing": (0, 0, [
        (0.0, "finish", None), FIRST, (0.01, "finish", None),
        (0.15, "tick", None),  # and the one that was given is no longer waited for
    ]),
    "a wake-up late by a whole period starts a new grid": (1, 0, [
        FIRST, (0.25, "tick", SILENT), (0.1, "next tick", SILENT), (0, "due", 0.55),
    ]),
    "an answer in a safe stop puts off the next repetition": (1, 0, [
        FIRST, (0.25, "tick", SILENT), (0.3, "state", SILENT), (0, "due", 0.401),
        (0.36, "tick", None),
    ]),
    "a re-arm needs a vehicle": (1, 0, [*STOPPED, (0.3, "rearm", "no vehicle")]),
}  # fmt: skip


@pytest.mark.parametrize("story", STORIES)
def test_without_a_vehicle(story):
    safe_stops, misses, rows = STORIES[story]
    controller = play(make(task="ours", armed_at_start=False), rows)
    assert (controller.safety.safe_stops, controller.deadline_misses) == (safe_stops, misses)
    assert not controller.waits_for_rearm  # it needs no permission


@pytest.mark.parametrize(
    "output",
    [None, NAN.astype(np.float64), np.float32(0.5), GOOD[:0], GOOD.reshape(1, 1), np.tile(GOOD, 2),
     np.array([1], np.int64), np.array([[[0.5]]], np.float32)],
)  # fmt: skip
def test_an_answer_of_another_form_is_a_failed_inference(output):
    controller = driving()
    for step in (1, 2):
        assert said(answer(controller, step, step * T, output)) == "inference_failed"
    assert [answer(controller, s, s * T).mode for s in range(3, 8)][-1] == "drive"


@pytest.mark.parametrize("needs_rearm", [False, True])
@pytest.mark.parametrize("begun", [[], [(0.1, "begin", None)]])
def test_a_policy_that_died_stops_for_good_and_says_so(needs_rearm, begun):
    controller = play(driving(needs_rearm), [
        *begun, (0, "dies", None), (0.11, "tick", DEAD), (0.15, "tick", None),
        # Past the time for an inference, and past silence.
        *[(1e-6, "next tick", DEAD)] * 20, (0.12, "rearm", "restart the runtime"),
    ])  # fmt: skip
    assert controller.deadline_misses == 0


def test_an_answer_to_a_state_older_than_two_periods_stops():
    """As after SIGSTOP and SIGCONT, where the state waited and the policy itself was quick."""
    controller = make()
    begin(controller, 0, 0.0, 0.9)
    assert said(controller.finish(GOOD, QUICK_NS, 0.901)) == TOO_LONG
    in_time = make()
    begin(in_time, 0, 0.0, 0.2)
    assert said(in_time.finish(GOOD, QUICK_NS, in_time.safety.answer_s)) == "drive"


@pytest.mark.parametrize("period_s", [0.01, 0.05, 1.0])
def test_every_limit_follows_the_policys_control_period(period_s):
    controller = Controller(ControllerConfig(shared_limits([PEDAL], {}), period_s))
    story = [(0.0, "state", "drive"), (2.19, "tick", None), (2.21, "tick", SILENT)]
    story += [(0.0, "next tick", SILENT), (3.3, "begin", None), (4.29, "tick", SILENT)]
    play(controller, [(periods * period_s, *row) for periods, *row in story])
    assert said(controller.tick(4.31 * period_s)) == TOO_LONG


def test_a_safe_stop_and_a_farewell_are_the_manifests_or_hold_the_last_value():
    lift = replace(PEDAL, name="lift", low=-40.0, high=80.0, stop=12.5)
    controller = make(actions=(PEDAL, STEERING, lift))
    answer(controller, 0, 0.0, np.array([0.4, -0.25, 70.0], np.float32))
    assert controller.tick(0.3).action == [-1.0, -0.25, 12.5]
    assert said(driving().farewell()) == "runtime_ended"
    idle = (make(), play(make(), [(0.0, "final", "drive")]), make(True, armed_at_start=False))
    assert [controller.farewell() for controller in idle] == [None] * 3


def test_each_deadline_miss_counts_once():
    controller = make()
    for step, arrived_s in enumerate((0.0, 0.15, 0.3)):  # answered later than a period
        begin(controller, step, arrived_s, arrived_s + 0.1)
        # A state in hand is due before the silence after it.
        assert controller.next_deadline_s() == pytest.approx(arrived_s + 0.2)
        controller.finish(GOOD, QUICK_NS, arrived_s + 0.11)
    assert controller.deadline_misses == 3
    play(controller, [(0.45, "begin", None), (0.56, "tick", TOO_LONG), (0.57, "tick", None)])
    assert controller.deadline_misses == 4


def test_an_order_says_how_long_its_own_inference_took():
    controller = make()
    controller.begin(Received(make_state(0), 0.0, 7), 0.0)
    order = controller.finish(GOOD, 12345, 0.01)
    assert (order.inference_ns, order.answers.arrived_ns, order.action) == (12345, 7, [0.5])
    assert controller.tick(0.225).inference_ns == 0
    begin(controller, 1, 0.226, 0.226)
    assert controller.finish(GOOD, 54321, 0.23).inference_ns == 54321  # in a safe stop, too
    begin(controller, 2, 0.3, 0.3)
    assert controller.tick(0.41).inference_ns == 0
    assert controller.farewell().inference_ns == 0


def test_without_a_vehicle_a_rate_limit_counts_control_periods_however_fast_they_pass():
    controller = make(vehicle={"pedal": ActionLimit(-1.0, 1.0, 2.5)})
    full = np.ones(1, np.float32)
    actions = [answer(controller, step, 0.003 * step, full).action[0] for step in range(3)]
    assert actions == pytest.approx([0.25, 0.5, 0.75])


def test_a_rate_limit_is_per_second_and_counts_from_the_last_order_whatever_its_mode():
    controller = make(vehicle={"pedal": ActionLimit(-1.0, 1.0, 2.5)}, needs_rearm=True)
    assert answer(controller, 0, 0.0).action == [0.25]
    assert answer(controller, 1, 0.1).action == pytest.approx([0.5])
    assert answer(controller, 2, 0.0, np.array([1.0], np.float32)).action == pytest.approx([0.5])
    controller.tick(0.4)
    answer(controller, 2, 0.4)
    assert not controller.rearm(0.45)
    times_s = enumerate((0.5, 0.6, 0.7, 0.71, 0.81), start=3)
    actions = [answer(controller, step, now_s).action[0] for step, now_s in times_s]
    assert actions == pytest.approx([-1.0] * 3 + [-0.975, -0.725])


SLOW = {"pedal": ActionLimit(-1.0, 0.5, slew_per_s=2.0)}


@pytest.mark.parametrize(
    ("wanted", "last", "elapsed_s", "limited"),
    [
        (1.0, 0.0, T, 0.2), (-1.0, 0.0, T, -0.2), (1.0, 0.4, T, 0.5), (1.0, 0.0, 0.005, 0.01),
        (1.0, 0.0, 0.0, 0.0),
    ],
)  # fmt: skip
def test_a_slow_vehicle_by_hand(wanted, last, elapsed_s, limited):
    limits = shared_limits([PEDAL], SLOW)
    assert limit_action([wanted], [last], limits, elapsed_s) == [limited]
    assert limits == shared_limits([replace(PEDAL, slew_per_s=2.0, high=0.5)], {})  # the same rule


def test_a_vehicle_without_the_policys_action_is_refused():
    with pytest.raises(UserError, match="no 'steering'"):
        shared_limits([STEERING], SLOW)
    with pytest.raises(UserError, match="do not meet"):
        shared_limits([PEDAL], {"pedal": ActionLimit(2.0, 3.0, 1.0)})
    vehicle = {"steering": ActionLimit(1.0, 3.0, 1.0)}
    assert shared_limits([STEERING], vehicle)["steering"] == (1.0, 1.0, 1.0, None)  # they meet
    controller = make(actions=(STEERING,), vehicle=vehicle)
    begin(controller, 0, 0.0, 0.0)
    assert controller.tick(0.2).action == [1.0]  # where it holds is within them from the start


# With a vehicle, which moves only with somebody's permission: safe stops, and whether only an
# operator can let it drive in the end.
LYING, PAUSED, FAULT = "vehicle_lying", "pause_too_long", "vehicle_fault"
VEHICLE_STORIES = {
    # It is no fault.
    "it stands at the end of an episode and drives in the next": (
        0, False, [FIRST, (0.1, "final", "final_state"), (9.9, "state", "drive")]
    ),
    "a re-arm needs a safe stop": (0, False, [FIRST, (0.0, "rearm", "nothing to re-arm")]),
    "a re-arm needs fresh states": (1, True, [*STOPPED, (0.3, "rearm", "no fresh states")]),
    "a re-arm with fresh states drives at the next": (1, False, [
        *STOPPED, *states(1.1, 9, SILENT), (1.95, "rearm", ""), (2.0, "state", "drive"),
    ]),
    "a permission in a safe stop is enough to wait for nobody": (
        1, False, [*STOPPED, (0.35, "state", SILENT), (0.4, "rearm", "")]
    ),
    "final states do not keep a permission alive": (1, True, [
        *states(0.0, 100, "final_state", "final"), (10.2, "state", PAUSED),
    ]),
    "final states do not keep the permission of a drive alive": (1, True, [
        FIRST, *states(0.1, 100, "final_state", "final"), (10.2, "state", PAUSED),
    ]),
    "final states do not keep a re-arm alive either": (1, True, [
        *STOPPED, *states(20.1, 5, SILENT, "final"), (20.6, "rearm", ""),
        *states(20.7, 99, SILENT, "final"), *states(30.7, 5, PAUSED, "final"),
    ]),
    "a drive of two states begins the pause anew": (0, False, [
        row
        for begun_s in range(0, 120, 6)
        for row in ((begun_s, "state", "drive"), (begun_s + T, "final", "final_state"))
    ]),
    # In standby it moves only for the drive that it was armed for.
    "a pause that was too long": (1, False, [
        (0.0, "final", "final_state"), *states(10.1, 8, PAUSED), (10.85, "rearm", ""),
        (10.9, "state", "drive"),
    ]),
    "another simulator": (1, False, [
        (0.0, "final", "final_state"), *states(1.0, 8, "other_session", "of another simulator"),
        (1.75, "rearm", ""), (1.8, "of another simulator", "drive"),
    ]),
    "a fault between two states takes the permission back": (1, True, [
        *STOPPED, *states(0.5, 4, SILENT), (0.81, "rearm", ""), (0, "fault", LYING),
        (0.85, "tick", None), (0, "fault", ""), *states(0.9, 7, FAULT),
    ]),
    "a vehicle at fault stops at the next tick and is not re-armed": (1, False, [
        FIRST, (0, "fault", LYING), (0.01, "tick", FAULT), (0.02, "rearm", LYING),
        *states(0.1, 9, FAULT), (0, "fault", ""), (1.0, "state", FAULT),  # nobody has allowed it
        (1.01, "rearm", ""), *states(1.1, 3, FAULT), (1.4, "state", "drive"),
    ]),
    "a fault before the first state is remembered": (1, False, [
        (0, "fault", LYING), (0.0, "tick", None), (0, "fault", ""), *states(0.1, 9, FAULT),
        (0.95, "rearm", ""), (1.0, "state", "drive"),
    ]),
    "what stopped a vehicle is said until it is re-armed though it has passed": (1, False, [
        FIRST, (0, "fault", LYING), (0.01, "tick", FAULT), (0, "fault", "vehicle_silent"),
        (0.1, "state", FAULT), (0, "words", "vehicle_silent"), (0, "fault", ""),
        *states(0.2, 4, FAULT), (0, "words", LYING),  # the first of them
        (1.0, "tick", SILENT), (0, "words", LYING), *states(1.1, 5, SILENT), (1.51, "rearm", ""),
        (0, "words", ""),
    ]),
}  # fmt: skip


UNARMED = "it waits for its first permission"
VEHICLE_STORIES[UNARMED] = (1, False, [
    (5.0, "tick", None), (0, "due", None), (5.0, "rearm", "no fresh states"),
    (6.0, "begin", None), (6.0, "tick", None),  # the answer comes first
    (6.001, "finish", "not_armed"), *states(6.1, 4, "not_armed"), (6.45, "rearm", ""),
    (6.5, "state", "drive"),
])  # fmt: skip


@pytest.mark.parametrize("story", VEHICLE_STORIES)
def test_with_a_vehicle(story):
    safe_stops, waits, rows = VEHICLE_STORIES[story]
    controller = make(needs_rearm=True, armed_at_start=story != UNARMED)
    assert controller.waits_for_rearm == (story == UNARMED)
    play(controller, rows)
    assert (controller.safety.safe_stops, controller.waits_for_rearm) == (safe_stops, waits)


EPISODE, LEASH, NOTHING = "episode", "leash", "nothing to re-arm"
ENDED = [FIRST, (0.1, "final", "final_state")]
# With a permission for each episode. The start is that of the first one.
EPISODE_STORIES = {
    "each new one waits for its own": (2, True, [
        *ENDED, *states(1.1, 9, EPISODE), (1.95, "rearm", ""), (2.0, "state", "drive"),
        (2.05, "rearm", NOTHING),  # sent twice
        (2.1, "final", "final_state"), *states(3.0, 9, EPISODE),
    ]),
    "however long the reset took": (1, False, [
        *ENDED, *states(60.0, 5, EPISODE), (60.45, "rearm", ""), (60.5, "state", "drive"),
    ]),
    "where the end of the last one was lost": (1, True, [
        FIRST, *states(0.1, 9, EPISODE, "of a later episode"),
    ]),
    "where all have one number": (
        1, True, [*ENDED, *states(0.2, 9, EPISODE, "of the same episode")]
    ),
    "where one state has taken the place of the end": (1, True, [
        FIRST, (0.1, "after a final that was not seen", EPISODE),
        *states(0.2, 9, EPISODE, "of the same episode"),
    ]),
    "where the end comes again and again": (1, True, [*ENDED, *states(0.2, 9, EPISODE, "final")]),
    "a re-arm before its first state is none": (1, True, [
        *ENDED, (0.15, "rearm", NOTHING), *states(0.2, 2, EPISODE), (0.9, "rearm", "no fresh"),
        *states(1.0, 9, SILENT),
    ]),
    "a re-arm in the last one's stop is none": (1, True, [
        *STOPPED, *states(0.5, 3, SILENT), (0.75, "rearm", ""), (0.8, "final", SILENT),
        *states(0.9, 9, EPISODE),
    ]),
    "another simulator is said to be one": (1, True, [
        *ENDED, *states(1.0, 8, "other_session", "of another simulator"),
    ]),
    "a fault while it waits": (1, False, [
        *ENDED, (0.5, "state", EPISODE), (0, "fault", LYING), (0.6, "state", FAULT),
        (0.65, "rearm", LYING), (0, "fault", ""), *states(0.7, 5, FAULT), (1.15, "rearm", ""),
        (1.2, "state", "drive"),
    ]),
    "a leash that is used up stops until the re-arm": (1, False, [
        FIRST, (0, "leash", True), (0.01, "tick", LEASH), *states(0.1, 9, LEASH),
        (0.95, "rearm", ""), *states(1.0, 4, LEASH), (1.4, "state", "drive"),
        (1.45, "rearm", NOTHING),  # no new leash for what drives
    ]),
    "a leash that is used up between two looks": (
        1, True, [FIRST, (0, "leash", True), (0.1, "state", LEASH)]
    ),
    "no episode gives a new leash": (1, True, [
        FIRST, (0, "leash", True), (0.1, "final", LEASH), *states(0.2, 9, LEASH),
    ]),
    "a leash that a re-armed vehicle uses before it drives": (1, True, [
        *STOPPED, *states(0.5, 3, SILENT), (0.75, "rearm", ""), (0, "leash", True),
        *states(0.8, 9, LEASH),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("story", EPISODE_STORIES)
def test_with_a_permission_for_each_episode(story):
    safe_stops, waits, rows = EPISODE_STORIES[story]
    controller = play(make(needs_rearm=True, each_episode=True), rows)
    assert (controller.safety.safe_stops, controller.waits_for_rearm) == (safe_stops, waits)


def test_a_re_arm_that_names_its_stop_is_for_no_other():
    controller = play(make(needs_rearm=True, each_episode=True), [*STOPPED, (0.5, "state", SILENT)])
    for other in ("simulator-a/0/0", "simulator-a/1/1", "simulator-b/0/1", "None/None/1"):
        assert controller.rearm(0.55, other)
        assert controller.waits_for_rearm
    assert controller.rearm(0.55, "simulator-a/0/1") == ""
    assert not controller.waits_for_rearm


def test_without_a_vehicle_no_episode_waits():
    rows = [(0.0, "final", "drive"), *states(1.0, 3, "drive")]
    assert play(make(each_episode=True), rows).safety.safe_stops == 0


def test_nobody_rides_into_a_new_episode():
    limits = shared_limits([PEDAL], {})
    config = ControllerConfig(limits, T, True, ride_s=0.5, each_episode=True)
    controller = Controller(config)
    play(controller, [FIRST, (0.121, "tick", "drive"), (0.2, "of a later episode", EPISODE)])
    due = [said(controller.tick(0.2 + step * T)) for step in range(1, 9)]
    assert {*due} <= {EPISODE, SILENT, None}


def fault_in_the_vehicle(controller):
    controller.vehicle_fault = LYING
    controller.tick(0.31)


def use_the_leash(controller):
    controller.leash_is_used = True
    controller.tick(0.31)


# What makes an event happen after 0.3 s, with a vehicle.
CAUSES = {
    Event.FRESH: lambda c: answer(c, 9, 0.32),
    Event.FINAL: lambda c: answer(c, 9, 0.32, final=True),
    Event.SILENT: lambda c: c.tick(0.9),
    Event.LATE: lambda c: answer(c, 9, 0.32, sent_ns=-(10**9)),
    Event.NOT_FINITE: lambda c: answer(c, 9, 0.32, NAN),
    Event.FAILED: lambda c: answer(c, 9, 0.32, None),
    Event.DEAD: lambda c: c.policy_died(),
    Event.TOO_LONG: lambda c: (begin(c, 9, 0.32, 0.32), c.tick(0.43)),
    Event.OTHER_SESSION: lambda c: answer(c, 9, 0.32, session="simulator-b"),
    Event.OTHER_TASK: lambda c: answer(c, 9, 0.32, task="another"),
    Event.VEHICLE: fault_in_the_vehicle,
    Event.EPISODE: lambda c: answer(c, 9, 0.32, episode=9),
    Event.LEASH: use_the_leash,
}
WAYS = {  # into each mode
    Mode.STANDBY: [(0.2, "state", "drive"), (0.3, "final", "final_state")],
    Mode.DRIVE: [(0.3, "state", "drive")],
    Mode.SAFE_STOP: [FIRST, (0.25, "tick", SILENT), (0.3, "state", SILENT)],
}


@pytest.mark.parametrize("event", CAUSES)
@pytest.mark.parametrize("mode", Mode)
def test_the_table_holds_in_every_mode(mode, event):
    controller = play(make(needs_rearm=True, task="ours"), WAYS[mode])
    assert controller.safety.mode is mode
    controller.each_episode = event is Event.EPISODE  # else the way into standby is one's end
    CAUSES[event](controller)
    assert controller.safety.mode is TRANSITIONS[mode, event]
    if controller.safety.mode is Mode.SAFE_STOP:
        assert controller.safety.reason == (event.value if event in FAULTS else SILENT)
        assert controller.waits_for_rearm


def test_held_up_states_do_not_feed_the_watchdog():
    """A state each 0.4 s, ever later: it stops when its ride ends, and waits for the operator."""
    controller = riding(0.5, needs_rearm=True)
    answer(controller, 0, 0.0)
    due = []
    for step in range(1, 20):
        while (due_s := controller.next_deadline_s() or math.inf) < 0.4 * step:
            due.append(said(controller.tick(due_s + 1e-6)))
        order = answer(controller, step, 0.4 * step, sent_ns=round(0.05e9 * step))
        assert order is None or order.mode == "safe_stop"
    assert due[:6] == ["drive"] * 5 + [SILENT]
    assert controller.waits_for_rearm
