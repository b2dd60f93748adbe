from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.person import (
    MAX_SLEW,
    SILENCE_S,
    WISHES,
    Input,
    Intent,
    Reading,
    Seat,
    TakeOver,
    distance,
)
from trainer.person.tests.people import LET_GO

ACTION = st.floats(-1.0, 1.0)
STEPS = st.lists(st.tuples(ACTION, ACTION, st.booleans()), min_size=1, max_size=60)
EPSILON = 1e-12


@given(STEPS)
def test_a_hand_over_never_jumps_and_all_but_the_policys_own_action_is_the_persons(steps):
    """Within a hand-over and at both of its ends the action moves by at most the slew."""
    take_over, last, before = TakeOver(), None, "policy"
    for policy, human, holds in steps:
        by_person = take_over.step(policy, human, holds)
        applied: Any = take_over.applied
        followed = before == take_over.state in ("policy", "human")
        if last is not None and not followed:
            assert distance(applied, last) <= MAX_SLEW + EPSILON
        # An intervention has one first step, which already moves towards the person.
        assert by_person is None or by_person.action == np.float32(applied)
        assert by_person is None or by_person.first == (before == "policy")
        if by_person and by_person.first:
            start = policy if last is None else last
            left = max(distance(human, start) - MAX_SLEW, 0.0)
            assert distance(human, applied) <= left + EPSILON
        assert by_person or (applied == policy and not holds)
        last, before = applied, take_over.state


@given(STEPS, ACTION, ACTION)
def test_a_person_who_holds_or_lets_go_for_long_is_followed_exactly(steps, policy, human):
    take_over = TakeOver()
    for step in steps:
        take_over.step(*step)
    for action, control in ((human, "human"), (policy, "policy")):
        for _ in range(4):
            by_person = take_over.step(policy, human, control == "human")
        decided = take_over.applied, take_over.control, by_person is not None
        assert decided == (action, control, control == "human")


def wheel(action):
    return Reading(action=action, by_moving=True)


# Through the middle and out again is still in the person's hands.
MOVED = [(wheel(0.1), 0.0, False), (wheel(0.2), 0.1, True), (wheel(0.1), 0.2, True),
         (wheel(0.0), 0.3, True), (wheel(-0.1), 0.7, True), (wheel(0.01), 0.8, True),
         (wheel(0.01), 1.3, True), (wheel(0.01), 1.5, False), (wheel(0.1), 1.6, False)]  # fmt: skip
# A device that takes over by holding is not moved, and one that is gone lets go.
HELD = [(Reading(action=1.0), 0.0, False), (Reading(action=0.0, engaged=True), 0.1, True),
        (wheel(1.0), 0.2, True), (Reading(), 0.3, False)]  # fmt: skip


@pytest.mark.parametrize("readings", [MOVED, HELD])
def test_moving_or_holding_takes_over_and_resting_or_letting_go_hands_back(readings):
    intent = Intent()
    for reading, now_s, wants_control in readings:
        assert intent.update(reading, now_s) == wants_control, now_s


OFF, HOLD = Input(0.0, 0.0, engaged=False), Input(0.0, 0.8, engaged=True)
RESTING, TURNED = (Input(0.0, place, engaged=False, by_moving=True) for place in (0.03, 0.8))


@pytest.fixture
def seat():
    seat = Seat()
    seat.sit_down(1)
    return seat


def take_over(seat, page=1, now_s=0.0):
    seat.hear(page, OFF, now_s)
    return seat.hear(page, HOLD, now_s)


@pytest.mark.parametrize(("off", "on"), [(OFF, HOLD), (RESTING, TURNED)])
def test_after_a_silence_the_hands_must_be_off_once_and_a_wheel_at_rest(seat, off, on):
    assert not seat.hear(1, on, 0.0), "it came holding"
    seat.hear(1, off, 0.0)
    assert seat.hear(1, on, 0.1)
    assert (seat.poll(0.1).action, seat.poll(0.1).by_moving) == (0.8, on.by_moving)
    late_s = 0.1 + SILENCE_S + 0.1
    assert not seat.hear(1, on, late_s)
    assert seat.poll(late_s) == LET_GO
    seat.hear(1, off, late_s + 0.1)
    assert seat.hear(1, on, late_s + 0.2)
    assert seat.poll(late_s + 0.2).action == 0.8


def test_a_tap_between_two_polls_counts_for_one_and_a_hold_ends_with_its_release(seat):
    take_over(seat)
    seat.hear(1, OFF, 0.05)
    assert seat.poll(0.1).action == 0.8
    assert not seat.poll(0.2).engaged
    take_over(seat, now_s=0.3)
    assert seat.poll(0.3).engaged
    seat.hear(1, HOLD, 0.35)
    seat.hear(1, OFF, 0.36)
    assert not seat.poll(0.4).engaged


def test_a_tap_of_the_trigger_while_its_button_is_held_counts_for_one(seat):
    take_over(seat)
    assert seat.poll(0.0).action == 0.8
    for action, now_s in ((-1.0, 0.01), (0.8, 0.02)):
        seat.hear(1, Input(0.0, action, engaged=True), now_s)
    assert [seat.poll(0.1).action for _ in range(2)] == [-1.0, 0.8]


PAGES = st.integers(1, 3)
EVENTS = st.one_of(
    st.tuples(st.just("sit_down"), PAGES),
    st.tuples(st.just("get_up"), PAGES),
    st.tuples(st.just("hear"), PAGES, st.booleans(), st.sets(st.sampled_from(WISHES))),
    st.tuples(st.just("wait"), st.floats(0.0, 0.4)),
)


@given(st.lists(EVENTS, max_size=40))
def test_only_the_driver_heard_lately_and_after_hands_off_ever_holds(events):
    """The seat beside a plain account of the same events."""
    seat, now_s, pages, told, wished = Seat(), 0.0, [], [], []
    heard: list[tuple[float, bool]] = []  # when, and whether engaged: of the present driver
    for kind, *what in events:
        if kind == "wait":
            now_s += what[0]
        elif kind == "sit_down" and what[0] not in pages:
            pages.append(what[0])
            seat.sit_down(what[0])
        elif kind == "get_up" and what[0] in pages:
            heard = [] if pages[0] == what[0] else heard
            pages.remove(what[0])
            seat.get_up(what[0])
        elif kind == "hear" and what[0] in pages:
            page, engaged, wishes = what
            seat.hear(page, Input(0.0, 0.5, engaged, wishes=tuple(wishes)), now_s)
            if page == pages[0]:
                heard.append((now_s, engaged))
                wished += list(wishes)
        reading = seat.poll(now_s)
        told += list(reading.wishes)
        assert reading.engaged == holds(heard, now_s)
        assert seat.is_heard(now_s) == (bool(heard) and now_s - heard[-1][0] <= SILENCE_S)
        assert all(seat.is_driver(each) == (each == pages[0]) for each in pages)
    assert set(told) == set(wished)
    assert len(told) <= len(wished)


def holds(heard, now_s):
    """Whether the last of an unbroken row of messages holds, with hands off before it."""
    if not heard or not heard[-1][1] or now_s - heard[-1][0] > SILENCE_S:
        return False
    row, later_s = [], heard[-1][0]
    for time_s, engaged in reversed(heard):
        if later_s - time_s > SILENCE_S:
            break
        row.append(engaged)
        later_s = time_s
    return not all(row)
