"""Who has the wheel, and when a hold counts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.person.interface import LET_GO, WISHES
from trainer.person.takeover import SILENCE_S, Input, Seat

OFF = Input(at_ms=0.0, action=0.0, engaged=False)
HOLD = Input(at_ms=0.0, action=0.8, engaged=True)
RESTING = Input(at_ms=0.0, action=0.03, engaged=False, by_moving=True)
TURNED = Input(at_ms=0.0, action=0.8, engaged=False, by_moving=True)


@pytest.fixture
def seat():
    seat = Seat()
    seat.sit_down(1)
    return seat


def take_over(seat, page=1, now_s=0.0):
    seat.hear(page, OFF, now_s)
    return seat.hear(page, HOLD, now_s)


def test_a_hold_is_read_at_once_and_silence_is_letting_go(seat):
    assert take_over(seat)
    reading = seat.poll(SILENCE_S)
    assert (reading.engaged, reading.action) == (True, 0.8)
    assert seat.poll(SILENCE_S + 1e-6) == LET_GO
    assert not seat.is_heard(SILENCE_S + 1e-6)


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


def test_the_driver_going_is_letting_go_and_the_next_page_drives(seat):
    seat.sit_down(2)
    seat.sit_down(3)
    take_over(seat)
    assert not take_over(seat, page=2)
    seat.get_up(3)
    assert seat.poll(0.0).engaged, "a watcher going changes nothing"
    seat.get_up(1)
    assert seat.poll(0.0) == LET_GO
    assert seat.is_driver(2)
    assert not seat.hear(2, HOLD, 0.1), "held while it watched"
    assert take_over(seat, page=2, now_s=0.2)


def test_a_tap_between_two_polls_counts_for_one(seat):
    take_over(seat)
    seat.hear(1, OFF, 0.05)
    assert seat.poll(0.1).action == 0.8
    assert not seat.poll(0.2).engaged


def test_a_hold_that_was_polled_ends_with_its_release(seat):
    take_over(seat)
    assert seat.poll(0.0).engaged
    seat.hear(1, HOLD, 0.05)
    seat.hear(1, OFF, 0.06)
    assert not seat.poll(0.1).engaged


def test_a_wish_outlives_its_page_and_is_told_once_and_a_tap_is_lost_with_it(seat):
    take_over(seat)
    seat.hear(1, Input(at_ms=0.0, action=0.0, engaged=False, wishes=("quit",)), 0.05)
    seat.get_up(1)
    reading = seat.poll(0.1)
    assert (reading.wishes, reading.engaged) == ({"quit"}, False)
    assert not seat.poll(0.1).wishes


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
    seat, now_s = Seat(), 0.0
    pages, told = [], []
    heard: list[tuple[float, bool]] = []  # when, and whether engaged: of the present driver
    wished = []
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
            said = Input(at_ms=0.0, action=0.5, engaged=engaged, wishes=tuple(wishes))
            seat.hear(page, said, now_s)
            if page == pages[0]:
                heard.append((now_s, engaged))
                wished += list(wishes)
        reading = seat.poll(now_s)
        told += list(reading.wishes)
        assert reading.engaged == holds(heard, now_s)
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
