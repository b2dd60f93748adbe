"""The controller with a vehicle, which moves only with somebody's permission; made-up times."""

from __future__ import annotations

import pytest

from edge_runtime.controller import Received
from edge_runtime.safety import Mode
from edge_runtime.tests.harness import GOOD, QUICK_NS, answer, make, make_state, stop


def test_a_vehicle_stands_at_the_end_of_an_episode_and_drives_in_the_next():
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0)
    order = answer(controller, 1, 0.1, final=True)
    assert (order.mode, order.reason, order.action) == ("safe_stop", "final_state", [-1.0])
    assert controller.safety.mode is Mode.STANDBY
    assert controller.safety.safe_stops == 0  # it is no fault
    assert answer(controller, 2, 0.2).mode == "drive"


def test_a_rearm_needs_a_vehicle_a_safe_stop_and_fresh_states():
    assert "no vehicle" in stop(make()).rearm(0.3)
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0)
    assert "nothing to re-arm" in controller.rearm(0.0)
    controller = stop(make(needs_rearm=True))
    assert "no fresh states" in controller.rearm(0.3)
    assert controller.waits_for_rearm


def test_a_rearm_with_fresh_states_drives_at_the_next():
    controller = stop(make(needs_rearm=True))
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
    controller = stop(make(needs_rearm=True))
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
    controller.begin(Received(make_state(0), 6.0, 0), 6.0)
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
        stop(controller)
        assert controller.waits_for_rearm == needs_rearm
    answer(controller, 1, 0.35)
    assert controller.rearm(0.4) == ""
    assert not controller.waits_for_rearm


def test_a_vehicle_fault_between_two_states_takes_the_permission_back():
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0)
    stop(controller)
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
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0)
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
    controller = make(needs_rearm=True)
    answer(controller, 0, 0.0)
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
    assert (controller.safety.reason, controller.vehicle_words) == (
        "no_fresh_state",
        "vehicle_lying",
    )
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
