"""The controller against made-up times: no clock, no socket, no policy. Then with a vehicle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.controller import (
    ActionLimit,
    Controller,
    Received,
    limit_action,
    neutral_action,
    shared_limits,
    stop_action,
)
from edge_runtime.safety import Mode
from edge_runtime.tests.harness import make_state
from edge_runtime.tests.policies import PEDAL, STEERING
from edge_runtime.util import UserError
from edge_runtime.vehicles.mock import MockVehicle

NAN = np.array([np.nan], np.float32)
GOOD = np.array([0.5], np.float32)
QUICK_NS = 1_000_000


def make(needs_rearm=False, actions=(PEDAL,), **options):
    return Controller(shared_limits(actions, {}), needs_rearm, **options)


def begin(controller, step, arrived_s, now_s, **changes):
    controller.begin(Received(make_state(step, **changes), arrived_s, 0), now_s)


def answer(controller, step, now_s, output=GOOD, **changes):
    begin(controller, step, now_s, now_s, **changes)
    return controller.finish(output, QUICK_NS, now_s + 0.001)


def driving(needs_rearm=False, **options):
    """A controller that has answered the state of step 0 at 0 s."""
    controller = make(needs_rearm, **options)
    answer(controller, 0, 0.0)
    return controller


def stopped(needs_rearm=False):
    """One that stopped at 0.3 s because no second state came."""
    controller = driving(needs_rearm)
    controller.tick(0.3)
    return controller


def test_the_first_state_is_answered_with_drive():
    order = answer(make(), 0, 5.0)
    assert (order.mode, order.action, order.reason) == ("drive", [0.5], "")
    assert order.answers.state.step == 0


def test_silence_stops_at_two_periods_and_repeats_on_a_grid():
    controller = driving()
    assert controller.next_deadline_s() == pytest.approx(0.22)
    assert controller.tick(0.219) is None
    orders = [controller.tick(0.221)]
    for late_s in (0.0, 0.03, 0.0, 0.05):  # a late wake-up does not shift those after it
        orders.append(controller.tick(controller.next_deadline_s() + late_s))
    assert controller.next_deadline_s() == pytest.approx(0.221 + 0.5)
    assert {(o.mode, o.reason, tuple(o.action)) for o in orders} == {
        ("safe_stop", "no_fresh_state", (-1.0,))
    }
    assert controller.safety.safe_stops == 1


def test_no_burst_after_a_long_pause_of_the_process():
    controller = driving()
    controller.tick(0.23)
    assert controller.tick(60.0) is not None
    assert controller.tick(60.05) is None


def test_five_fresh_states_drive_again():
    controller = stopped()
    modes = [answer(controller, step, 1 + step * 0.1).mode for step in range(1, 7)]
    assert modes == ["safe_stop"] * 4 + ["drive"] * 2


def test_a_gap_between_fresh_states_starts_the_count_again_without_any_tick():
    controller = driving()
    times = [1.0, 1.1, 1.2, 1.3, 1.53, 1.6, 1.7, 1.8, 1.9]
    modes = [answer(controller, step, now_s).mode for step, now_s in enumerate(times, 1)]
    assert modes == ["safe_stop"] * 8 + ["drive"]


@pytest.mark.parametrize("after_s", [0.2, 0.21, 0.22])
def test_no_drive_goes_on_with_another_simulator(after_s):
    """It may take over from 2 T on, within the grace for a lost state, too."""
    controller = driving()
    order = answer(controller, 0, after_s, session="simulator-b")
    assert (order.mode, order.reason) == ("safe_stop", "no_fresh_state")


def test_a_nan_stops_with_the_very_state_and_every_further_one():
    controller = driving()
    orders = [answer(controller, step, step * 0.1, NAN) for step in range(1, 9)]
    assert {(o.mode, o.reason) for o in orders} == {("safe_stop", "output_not_finite")}
    assert [o.answers.state.step for o in orders] == list(range(1, 9))


def test_states_of_another_task_stop_for_as_long_as_they_come():
    controller = make(task="left_turn, pedal -1 to 1")
    assert answer(controller, 0, 0.0).mode == "drive"  # an older simulator does not say
    assert answer(controller, 1, 0.1, task="left_turn, pedal -1 to 1").mode == "drive"
    other = {"task": "congestion, steering -1 to 1"}
    orders = [answer(controller, step, step * 0.1, **other) for step in range(2, 9)]
    orders.append(answer(controller, 9, 0.9, NAN, final=True, **other))
    assert {(o.mode, o.reason) for o in orders} == {("safe_stop", "other_task")}


@pytest.mark.parametrize(
    "output",
    [None, NAN.astype(np.float64), np.float32(0.5), GOOD[:0], GOOD.reshape(1, 1), np.tile(GOOD, 2),
     np.array([1], np.int64), np.array([[[0.5]]], np.float32)],
)  # fmt: skip
def test_an_answer_of_another_form_is_a_failed_inference(output):
    controller = driving()
    orders = [answer(controller, step, step * 0.1, output) for step in (1, 2)]
    assert {(o.mode, o.reason) for o in orders} == {("safe_stop", "inference_failed")}
    assert [o.action for o in orders] == [[-1.0]] * 2
    assert [answer(controller, s, s * 0.1).mode for s in range(3, 8)][-1] == "drive"


def test_an_inference_longer_than_a_period_stops_while_it_runs():
    controller = driving()
    begin(controller, 1, 0.1, 0.1)
    assert controller.next_deadline_s() == pytest.approx(0.2)
    assert controller.tick(0.2) is None
    assert controller.tick(0.201).reason == "inference_too_long"
    assert controller.finish(GOOD, 10**9, 1.1) is None
    assert controller.deadline_misses == 1
    assert controller.safety.mode is Mode.SAFE_STOP


def test_a_late_answer_is_not_used_even_where_no_tick_came_between():
    controller = make()
    begin(controller, 0, 0.0, 0.0)
    order = controller.finish(GOOD, 10**9, 0.15)
    assert (order.mode, order.reason) == ("safe_stop", "inference_too_long")


def test_between_episodes_there_is_no_watchdog():
    controller = make()
    assert answer(controller, 0, 0.0, final=True).mode == "drive"
    assert controller.next_deadline_s() is None
    assert controller.tick(9.0) is None
    assert answer(controller, 0, 10.0, episode=1).mode == "drive"
    assert controller.safety.safe_stops == 0


@pytest.mark.parametrize("needs_rearm", [False, True])
@pytest.mark.parametrize("begun", [False, True])
def test_a_policy_that_died_stops_for_good_and_says_so(needs_rearm, begun):
    controller = driving(needs_rearm=needs_rearm)
    if begun:
        begin(controller, 1, 0.1, 0.1)
    controller.policy_died()
    orders = [controller.tick(0.11)]
    assert controller.tick(0.15) is None
    for _ in range(20):  # past the time for an inference, and past silence
        orders.append(controller.tick(controller.next_deadline_s() + 1e-6))
    assert {(o.mode, o.reason) for o in orders} == {("safe_stop", "policy_thread_dead")}
    assert controller.deadline_misses == 0
    assert "restart the runtime" in controller.rearm(0.12)


def test_a_policy_that_died_before_the_first_state_tells_nobody_and_stands():
    controller = make()
    controller.policy_died()
    assert controller.tick(0.0) is None
    assert controller.next_deadline_s() is None
    assert controller.safety.reason == "policy_thread_dead"


def test_nothing_is_due_before_the_first_state():
    controller = make()
    assert controller.next_deadline_s() is None
    assert controller.tick(100.0) is None
    assert controller.farewell() is None


def test_an_answer_to_a_state_older_than_two_periods_stops():
    """As after SIGSTOP and SIGCONT, where the state waited and the policy itself was quick."""
    controller = make()
    begin(controller, 0, 0.0, 0.9)
    order = controller.finish(GOOD, QUICK_NS, 0.901)
    assert (order.mode, order.reason) == ("safe_stop", "inference_too_long")


def test_a_safe_stop_holds_the_last_steering():
    controller = make(actions=(PEDAL, STEERING))
    answer(controller, 0, 0.0, np.array([0.4, -0.25], np.float32))
    assert controller.tick(0.3).action == [-1.0, -0.25]


def test_the_farewell_brakes():
    controller = driving()
    order = controller.farewell()
    assert (order.mode, order.action, order.reason) == ("safe_stop", [-1.0], "runtime_ended")


def test_between_episodes_and_before_the_first_there_is_no_farewell():
    controller = make()
    answer(controller, 0, 0.0, final=True)
    assert controller.farewell() is None
    assert make(needs_rearm=True, armed_at_start=False).farewell() is None


def test_an_answer_later_than_a_period_is_a_deadline_miss():
    controller = make()
    begin(controller, 0, 0.0, 0.15)
    controller.finish(GOOD, QUICK_NS, 0.16)
    assert controller.deadline_misses == 1


def test_exactly_one_period_is_in_time():
    controller = make()
    begin(controller, 0, 0.0, 0.0)
    assert controller.finish(GOOD, QUICK_NS, 0.1).mode == "drive"
    answer(controller, 1, 0.15)
    assert controller.deadline_misses == 0


def test_each_miss_counts_once():
    controller = make()
    for step, arrived_s in enumerate((0.0, 0.15, 0.3)):
        begin(controller, step, arrived_s, arrived_s + 0.1)
        controller.finish(GOOD, QUICK_NS, arrived_s + 0.11)
    assert controller.deadline_misses == 3
    begin(controller, 3, 0.45, 0.45)
    for now_s in (0.56, 0.57):
        controller.tick(now_s)
    assert controller.deadline_misses == 4


def test_an_order_says_how_long_its_own_inference_took():
    controller = make()
    controller.begin(Received(make_state(0), 0.0, 7), 0.0)
    order = controller.finish(GOOD, 12345, 0.01)
    assert (order.inference_ns, order.answers.arrived_ns) == (12345, 7)
    assert controller.tick(0.225).inference_ns == 0
    begin(controller, 1, 0.226, 0.226)
    assert controller.finish(GOOD, 54321, 0.23).inference_ns == 54321  # in a safe stop, too
    begin(controller, 2, 0.3, 0.3)
    assert controller.tick(0.41).inference_ns == 0
    assert controller.farewell().inference_ns == 0


def test_an_answer_without_a_question_is_nothing():
    controller = make()
    assert controller.finish(GOOD, QUICK_NS, 0.0) is None
    answer(controller, 0, 0.0)
    assert controller.finish(GOOD, QUICK_NS, 0.01) is None
    assert controller.tick(0.15) is None  # and the one that was given is no longer waited for


def test_a_wake_up_late_by_a_whole_period_starts_a_new_grid():
    controller = driving()
    controller.tick(0.25)
    late_s = controller.next_deadline_s() + 0.1
    assert controller.tick(late_s) is not None
    assert controller.next_deadline_s() == late_s + 0.1


def test_an_answer_in_a_safe_stop_puts_off_the_next_repetition():
    controller = driving()
    controller.tick(0.25)
    answer(controller, 1, 0.3)
    assert controller.next_deadline_s() == pytest.approx(0.401)
    assert controller.tick(0.36) is None


def test_a_state_in_hand_is_due_before_the_silence_after_it():
    controller = driving()
    begin(controller, 1, 0.1, 0.15)
    assert controller.next_deadline_s() == pytest.approx(0.25)


def test_a_rate_limit_counts_from_the_last_order_whatever_its_mode():
    controller = Controller({"pedal": ActionLimit(-1.0, 1.0, 2.5)}, needs_rearm=False)
    assert answer(controller, 0, 0.0).action == [0.25]
    assert answer(controller, 1, 0.1).action == pytest.approx([0.5])
    controller.tick(0.4)
    actions = [answer(controller, step, step * 0.1 + 0.2).action[0] for step in range(2, 8)]
    assert actions == pytest.approx([-1.0] * 4 + [-0.75, -0.5])


@pytest.mark.parametrize("states_per_s", [10, 200, 1000])
def test_a_rate_limit_is_per_second_however_many_states_come(states_per_s):
    controller = Controller({"steering": ActionLimit(-1.0, 1.0, 2.0)}, needs_rearm=False)
    steps = range(states_per_s // 2 + 1)
    told = [answer(controller, step, step / states_per_s).action[0] for step in steps]
    assert told == sorted(told)
    # It wants 0.5, and begins at 0 with a step of one period: half a second is more than enough.
    assert told[0] == pytest.approx(0.2)
    assert max(b - a for a, b in zip(told, told[1:])) <= 2.0 / states_per_s + 1e-9
    assert told[-1] == 0.5


def test_a_stop_between_two_drives_gives_no_time_away():
    controller = Controller({"pedal": ActionLimit(-1.0, 1.0, 2.0)}, needs_rearm=False)
    answer(controller, 0, 0.0)
    controller.tick(0.3)
    for step in range(1, 5):
        answer(controller, step, 0.4 + step * 0.1)
    order = answer(controller, 5, 0.81)
    assert order.mode == "drive"
    assert order.action == pytest.approx([-1.0 + 2.0 * 0.01])


T = 0.1
SLOW = {"pedal": ActionLimit(-1.0, 0.5, slew_per_s=2.0)}
units = st.floats(-1, 1)
times_s = st.one_of(st.floats(0, 3), st.sampled_from([0.0, 0.005, T, 0.25, math.inf]))


@given(st.floats(-3, 3), units, times_s)
def test_without_a_vehicle_only_the_manifest_bounds(wanted, last, elapsed_s):
    rows = shared_limits([PEDAL], {})
    assert limit_action([wanted], [last], rows, elapsed_s) == [min(max(wanted, -1.0), 1.0)]


@given(units, units, times_s)
def test_the_mock_lets_every_action_through_unchanged(wanted, last, elapsed_s):
    rows = shared_limits([PEDAL], MockVehicle.limits)
    assert limit_action([wanted], [last], rows, elapsed_s) == [wanted]


@given(st.floats(-3, 3), st.floats(-1, 0.5), times_s)
def test_a_slow_vehicle_moves_at_most_its_share_of_the_time(wanted, last, elapsed_s):
    (limited,) = limit_action([wanted], [last], shared_limits([PEDAL], SLOW), elapsed_s)
    assert abs(limited - last) <= 2.0 * min(elapsed_s, T) + 1e-12
    assert -1.0 <= limited <= 0.5


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 0.3)), min_size=1, max_size=60))
def test_however_often_it_is_told_it_moves_no_faster_per_second(commands):
    rows, last, now_s = shared_limits([PEDAL], SLOW), [0.0], 0.0
    told = [(now_s, 0.0)]
    for wanted, elapsed_s in commands:
        last, now_s = limit_action([wanted], last, rows, elapsed_s), now_s + elapsed_s
        told.append((now_s, last[0]))
    for index, (then_s, then) in enumerate(told):
        for later_s, later in told[index + 1 :]:
            assert abs(later - then) <= 2.0 * (later_s - then_s) + 1e-9


def test_by_hand():
    rows = shared_limits([PEDAL], SLOW)
    assert limit_action([1.0], [0.0], rows, T) == [0.2]
    assert limit_action([-1.0], [0.0], rows, T) == [-0.2]
    assert limit_action([1.0], [0.4], rows, T) == [0.5]
    assert limit_action([1.0], [0.0], rows, 0.005) == [0.01]
    assert limit_action([1.0], [0.0], rows, 9.0) == [0.2]
    assert limit_action([1.0], [0.0], rows, -1.0) == [0.0]


def test_a_stop_is_full_brake_at_once_and_holds_the_steering():
    rows = shared_limits([PEDAL, STEERING], {})
    assert stop_action([0.7, 0.3], rows) == [-1.0, 0.3]
    assert neutral_action(rows) == [0.0, 0.0]


def test_a_vehicle_without_the_policys_action_is_refused():
    with pytest.raises(UserError, match="no 'steering'"):
        shared_limits([STEERING], SLOW)
    with pytest.raises(UserError, match="do not meet"):
        shared_limits([PEDAL], {"pedal": ActionLimit(2.0, 3.0, 1.0)})
    row = shared_limits([PEDAL], {"pedal": ActionLimit(1.0, 3.0, 1.0)})["pedal"]
    assert (row.low, row.high) == (1.0, 1.0)  # they meet in one point


# With a vehicle, which moves only with somebody's permission.


def test_a_vehicle_stands_at_the_end_of_an_episode_and_drives_in_the_next():
    controller = driving(needs_rearm=True)
    order = answer(controller, 1, 0.1, final=True)
    assert (order.mode, order.reason, order.action) == ("safe_stop", "final_state", [-1.0])
    assert controller.safety.mode is Mode.STANDBY
    assert controller.safety.safe_stops == 0  # it is no fault
    assert answer(controller, 2, 0.2).mode == "drive"


def test_a_rearm_needs_a_vehicle_a_safe_stop_and_fresh_states():
    assert "no vehicle" in stopped().rearm(0.3)
    controller = driving(needs_rearm=True)
    assert "nothing to re-arm" in controller.rearm(0.0)
    controller = stopped(needs_rearm=True)
    assert "no fresh states" in controller.rearm(0.3)
    assert controller.waits_for_rearm


def test_a_rearm_with_fresh_states_drives_at_the_next():
    controller = stopped(needs_rearm=True)
    modes = [answer(controller, step, 1 + step * 0.1).mode for step in range(1, 10)]
    assert set(modes) == {"safe_stop"}
    assert controller.rearm(1.95) == ""
    assert answer(controller, 10, 2.0).mode == "drive"


def test_a_vehicle_goes_on_between_two_episodes_of_one_drive():
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0, final=True)
    assert answer(controller, 0, 9.9, episode=1).mode == "drive"
    assert controller.safety.safe_stops == 0


@pytest.mark.parametrize("drives_first", [True, False])
def test_final_states_are_no_drive_and_do_not_keep_a_permission_alive(drives_first):
    controller = make(needs_rearm=True)
    if drives_first:
        answer(controller, 0, 0.0)
    for episode in range(1, 101):
        order = answer(controller, 0, episode * 0.1 - 0.1, episode=episode, final=True)
        assert (order.mode, order.reason) == ("safe_stop", "final_state")
    order = answer(controller, 0, 10.2, episode=102)
    assert (order.mode, order.reason) == ("safe_stop", "pause_too_long")
    assert controller.waits_for_rearm


def test_final_states_do_not_keep_a_rearm_alive_either():
    controller = stopped(needs_rearm=True)
    for step in range(1, 6):
        answer(controller, step, 20.0 + step * 0.1, final=True)
    assert controller.rearm(20.6) == ""
    for step in range(6, 110):
        answer(controller, step, 20.1 + step * 0.1, final=True)
    assert controller.waits_for_rearm
    assert controller.safety.reason == "pause_too_long"


def test_a_drive_of_two_states_begins_the_pause_anew():
    controller = make(needs_rearm=True)
    for episode in range(20):
        assert answer(controller, 0, episode * 6.0, episode=episode).mode == "drive"
        answer(controller, 1, episode * 6.0 + 0.1, episode=episode, final=True)
    assert controller.safety.safe_stops == 0


@pytest.mark.parametrize(
    ("now_s", "session", "reason"),
    [(10.1, "simulator-a", "pause_too_long"), (1.0, "simulator-b", "other_session")],
)
def test_a_vehicle_in_standby_moves_only_for_the_drive_it_was_armed_for(now_s, session, reason):
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0, final=True)
    orders = [
        answer(controller, step, now_s + step * 0.1, episode=1, session=session)
        for step in range(8)
    ]
    assert {(o.mode, o.reason) for o in orders} == {("safe_stop", reason)}
    assert controller.waits_for_rearm
    assert controller.rearm(now_s + 0.75) == ""
    assert answer(controller, 8, now_s + 0.8, episode=1, session=session).mode == "drive"


def test_without_a_vehicle_a_pause_and_another_simulator_are_no_fault():
    controller = make()
    answer(controller, 0, 0.0, final=True)
    assert answer(controller, 0, 60.0, session="simulator-b").mode == "drive"


def test_a_service_with_a_vehicle_waits_for_its_first_permission():
    controller = make(needs_rearm=True, armed_at_start=False)
    assert (controller.tick(5.0), controller.next_deadline_s()) == (None, None)
    assert controller.waits_for_rearm
    assert "no fresh states" in controller.rearm(5.0)
    begin(controller, 0, 6.0, 6.0)
    assert controller.tick(6.0) is None  # the answer comes first
    order = controller.finish(GOOD, QUICK_NS, 6.001)
    assert (order.mode, order.reason) == ("safe_stop", "not_armed")
    for step in range(1, 5):
        assert answer(controller, step, 6.0 + step * 0.1).mode == "safe_stop"
    assert controller.rearm(6.45) == ""
    assert answer(controller, 5, 6.5).mode == "drive"


def test_a_service_without_a_vehicle_needs_no_permission():
    assert answer(make(armed_at_start=False), 0, 0.0).mode == "drive"


def test_only_a_stopped_vehicle_without_permission_waits_for_the_operator():
    for needs_rearm in (False, True):
        controller = make(needs_rearm=needs_rearm)
        assert not controller.waits_for_rearm
        answer(controller, 0, 0.0)
        assert not controller.waits_for_rearm
        controller.tick(0.3)
        assert controller.waits_for_rearm == needs_rearm
    answer(controller, 1, 0.35)
    assert controller.rearm(0.4) == ""
    assert not controller.waits_for_rearm


def test_a_vehicle_fault_between_two_states_takes_the_permission_back():
    controller = stopped(needs_rearm=True)
    for step in range(1, 5):
        answer(controller, step, 0.4 + step * 0.1)
    assert controller.rearm(0.81) == ""
    controller.vehicle_fault = "vehicle_lying"
    controller.tick(0.85)
    controller.vehicle_fault = ""
    assert controller.waits_for_rearm
    orders = [answer(controller, step, 0.4 + step * 0.1) for step in range(5, 12)]
    assert {(order.mode, order.reason) for order in orders} == {("safe_stop", "vehicle_fault")}


def test_a_vehicle_at_fault_stops_at_the_next_tick_and_is_not_rearmed():
    controller = driving(needs_rearm=True)
    controller.vehicle_fault = "vehicle_silent"
    order = controller.tick(0.01)
    assert (order.mode, order.reason) == ("safe_stop", "vehicle_fault")
    assert "vehicle_silent" in controller.rearm(0.02)
    for step in range(1, 10):
        assert answer(controller, step, step * 0.1).mode == "safe_stop"
    controller.vehicle_fault = ""
    assert answer(controller, 10, 1.0).mode == "safe_stop"  # nobody has allowed it
    assert controller.rearm(1.01) == ""
    modes = [answer(controller, step, step * 0.1).mode for step in range(11, 16)]
    assert modes[-1] == "drive"


def test_what_stopped_a_vehicle_is_said_until_it_is_rearmed_though_it_has_passed():
    controller = driving(needs_rearm=True)
    controller.vehicle_fault = "vehicle_lying"
    controller.tick(0.01)
    controller.vehicle_fault = "vehicle_silent"
    answer(controller, 1, 0.1)
    assert controller.vehicle_words == "vehicle_silent"
    controller.vehicle_fault = ""
    for step in range(2, 6):
        answer(controller, step, step * 0.1)
        assert controller.vehicle_words == "vehicle_lying"  # the first of them
    controller.tick(1.0)
    words = (controller.safety.reason, controller.vehicle_words)
    assert words == ("no_fresh_state", "vehicle_lying")
    for step in range(11, 16):
        answer(controller, step, step * 0.1)
    assert controller.rearm(1.51) == ""
    assert controller.vehicle_words == ""


def test_a_vehicle_at_fault_never_begins_to_drive():
    controller = make(needs_rearm=True)
    controller.vehicle_fault = "vehicle_lying"
    assert controller.tick(0.0) is None
    order = answer(controller, 0, 0.0)
    assert (order.mode, order.reason) == ("safe_stop", "vehicle_fault")
