"""The chassis's state machine: every pair of its tables, and the traps by their names."""

import itertools
from pathlib import Path

import pytest

from hil_tests.mock_hunter import chassis as rules
from hil_tests.mock_hunter.chassis import (
    BITS,
    CONDITION,
    CONTROL,
    Chassis,
    Condition,
    Control,
    Event,
)

TIMEOUT_S = 0.5
CONTROL_EVENTS = [
    Event.CAN_MODE, Event.STANDBY_MODE, Event.COMMAND, Event.TIMEOUT, Event.REMOTE_ON,
    Event.REMOTE_OFF,
]  # fmt: skip
DRIVING = Chassis(Control.CAN, brake_locked=False, commanded_s=0.0)


def test_every_pair_of_state_and_event_has_an_answer_in_one_table():
    assert list(CONTROL) == CONTROL_EVENTS
    assert [*CONTROL, *CONDITION] == list(Event)
    assert {len(row) for row in CONTROL.values()} == {len(Control)}
    assert {len(row) for row in CONDITION.values()} == {len(Condition)}


def test_these_and_no_others_lead_to_can_control_from_outside():
    """Anything else that gave control to the bus would be a way to move without being asked."""
    found = {
        (state, event)
        for state, event in itertools.product(Control, CONTROL_EVENTS)
        if state is not Control.CAN
        and rules.advance(DRIVING._replace(control=state), event).control is Control.CAN
    }
    assert found == {
        (Control.STANDBY, Event.CAN_MODE),
        (Control.LINK_LOST, Event.CAN_MODE),
        (Control.LINK_LOST, Event.COMMAND),
        (Control.REMOTE_OVER_CAN, Event.REMOTE_OFF),
    }


@pytest.mark.parametrize("event", CONTROL_EVENTS)
@pytest.mark.parametrize("state", [Control.REMOTE, Control.REMOTE_OVER_CAN])
def test_no_frame_takes_control_from_the_remote(state, event):
    after = rules.advance(DRIVING._replace(control=state), event).control
    remote = {Control.REMOTE, Control.REMOTE_OVER_CAN}
    assert (after in remote) == (event is not Event.REMOTE_OFF)


@pytest.mark.parametrize("state", Control)
def test_the_remote_takes_over_from_anyone(state):
    after = rules.advance(DRIVING._replace(control=state), Event.REMOTE_ON)
    assert after.control in {Control.REMOTE, Control.REMOTE_OVER_CAN}
    assert not rules.obeys(after)


@pytest.mark.parametrize("control", Control)
@pytest.mark.parametrize("condition", Condition)
@pytest.mark.parametrize("locked", [False, True])
def test_the_bus_drives_only_in_can_control_without_errors_and_brake(control, condition, locked):
    chassis = Chassis(control, condition, locked)
    drives = control is Control.CAN and condition is Condition.OK and not locked
    assert rules.obeys(chassis) == drives


def test_the_link_is_lost_after_its_time_and_not_before():
    assert rules.take_time(DRIVING, 0.5, TIMEOUT_S).control is Control.CAN
    assert rules.take_time(DRIVING, 0.501, TIMEOUT_S).control is Control.LINK_LOST
    kept = rules.take_command(DRIVING, 0.4)
    assert rules.take_time(kept, 0.9, TIMEOUT_S).control is Control.CAN


def test_standby_by_frame_is_kept_whatever_is_commanded():
    stood_down = rules.advance(DRIVING, Event.STANDBY_MODE)
    assert not rules.obeys(rules.take_command(stood_down, 0.1))


def test_can_mode_starts_its_own_time_and_does_not_prolong_it():
    stale = Chassis(brake_locked=False, commanded_s=1.0)
    taken = rules.take_can_mode(stale, 9.0)
    assert rules.take_time(taken, 9.5, TIMEOUT_S).control is Control.CAN
    again = rules.take_can_mode(taken, 9.4)
    assert rules.take_time(again, 9.6, TIMEOUT_S).control is Control.LINK_LOST


@pytest.mark.parametrize("name", BITS)
def test_an_error_stops_and_goes_as_its_row_says(name):
    row = BITS[name]
    ill = rules.take_cause(DRIVING, name, True)
    assert ill.errors == {name}
    assert rules.obeys(ill) != row.stops
    assert rules.take_clear(ill).errors == {name}  # the cause is still there
    over = rules.take_cause(ill, name, False)
    assert over.errors == ({name} if row.latches else set())
    assert rules.obeys(over) == (not (row.latches and row.stops))
    assert rules.obeys(rules.take_clear(over))


def test_an_emergency_stop_and_an_error_go_one_by_one():
    chassis = rules.advance(rules.take_cause(DRIVING, "driver", True), Event.ESTOP_ON)
    assert chassis.condition is Condition.ESTOP_AND_EXCEPTION
    released = rules.advance(chassis, Event.ESTOP_OFF)
    assert released.condition is Condition.EXCEPTION
    healed = rules.take_clear(rules.take_cause(chassis, "driver", False))
    assert healed.condition is Condition.ESTOP


def test_of_two_errors_the_second_still_stops():
    both = rules.take_cause(rules.take_cause(DRIVING, "link_steer", True), "undervoltage", True)
    one = rules.take_cause(both, "link_steer", False)
    assert not rules.obeys(one)
    assert rules.obeys(rules.take_cause(one, "undervoltage", False))


@pytest.mark.parametrize("table", [CONTROL, CONDITION])
def test_the_tables_stand_in_the_readme(table):
    text = Path(rules.__file__).with_name("README.md").read_text()
    states = type(next(iter(table.values()))[0])
    assert f"| event | {' | '.join(f'in {state.value}' for state in states)} |" in text
    for event, row in table.items():
        assert f"| {event.value} | {' | '.join(after.value for after in row)} |" in text
