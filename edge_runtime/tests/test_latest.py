from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime import latest as latest_module
from edge_runtime.latest import TAKEOVER_SILENCE_S, LatestState
from edge_runtime.tests.harness import make_state
from edge_runtime.wire import Reason


def reason_of(latest, state, now_s):
    rejection = latest.offer(state, now_s)
    return rejection and rejection.reason


def test_in_order_all_are_accepted():
    latest = LatestState()
    assert [latest.offer(make_state(step), step * 0.1) for step in range(9)] == [None] * 9
    assert (latest.accepted, latest.rejected) == (9, {})


def test_old_and_equal_states_are_rejected_and_counted():
    latest = LatestState()
    latest.offer(make_state(5), 0.0)
    assert reason_of(latest, make_state(5), 0.1) is Reason.DUPLICATE
    assert reason_of(latest, make_state(4), 0.1) is Reason.STALE
    assert reason_of(latest, make_state(0, episode=1), 0.2) is None
    assert reason_of(latest, make_state(9), 0.3) is Reason.STALE
    assert latest.rejected == {"duplicate": 1, "stale": 2}


def test_a_second_simulator_waits_for_silence():
    latest = LatestState()
    other = "simulator-b"
    latest.offer(make_state(0), 0.0)
    assert reason_of(latest, make_state(0, session=other), 0.19) is Reason.FOREIGN_SESSION
    latest.offer(make_state(1), 0.19)
    assert reason_of(latest, make_state(0, session=other), 0.3) is Reason.FOREIGN_SESSION
    assert reason_of(latest, make_state(1, session=other), 0.39) is None
    assert reason_of(latest, make_state(2), 0.4) is Reason.FOREIGN_SESSION


def test_a_foreign_state_does_not_end_the_silence():
    latest = LatestState()
    latest.offer(make_state(0), 0.0)
    for tenth in range(1, 2):
        latest.offer(make_state(0, session="simulator-b"), tenth / 10)
    assert latest.offer(make_state(0, session="simulator-b"), TAKEOVER_SILENCE_S) is None


def test_a_stale_message_still_shows_that_its_simulator_is_there():
    latest = LatestState()
    latest.offer(make_state(3), 0.0)
    latest.offer(make_state(3), 0.15)
    assert reason_of(latest, make_state(0, session="b"), 0.25) is Reason.FOREIGN_SESSION


def test_a_delayed_message_of_an_earlier_simulator_does_not_go_back():
    latest = LatestState()
    latest.offer(make_state(7), 0.0)
    latest.offer(make_state(0, session="b"), 1.0)
    assert reason_of(latest, make_state(7), 2.0) is Reason.DUPLICATE
    assert reason_of(latest, make_state(8), 2.0) is None


def test_no_state_from_further_ahead_than_a_simulator_can_be():
    latest = LatestState()
    latest.offer(make_state(5, episode=2), 10.0)
    for state in (make_state(10_006, episode=2), make_state(10_001, episode=3)):
        assert reason_of(latest, state, 10.0) is Reason.FUTURE
    assert reason_of(latest, make_state(0, episode=13), 10.0) is Reason.FUTURE
    assert reason_of(latest, make_state(6, episode=2), 10.0) is None  # and none of them counts
    assert reason_of(latest, make_state(10_006, episode=2), 10.0) is None
    assert reason_of(latest, make_state(10_000, episode=12), 10.0) is None


def test_after_an_outage_a_simulator_may_be_far_ahead():
    latest = LatestState()
    latest.offer(make_state(0), 0.0)
    assert reason_of(latest, make_state(20_001), 100.0) is Reason.FUTURE
    assert reason_of(latest, make_state(20_000), 100.0) is None
    assert reason_of(latest, make_state(0, episode=31), 120.0) is Reason.FUTURE
    assert reason_of(latest, make_state(0, episode=30), 120.0) is None


def test_the_first_state_of_a_session_may_stand_anywhere():
    assert LatestState().offer(make_state(10**12, episode=10**9), 0.0) is None


def test_a_rejection_says_both_places():
    latest = LatestState()
    latest.offer(make_state(7, episode=1), 0.0)
    rejection = latest.offer(make_state(3, episode=1), 0.1)
    assert rejection is not None
    assert rejection.detail == "episode 1 step 3 after episode 1 step 7"


def test_sixteen_past_sessions_may_come_back_with_newer_states():
    latest = LatestState()
    for number in range(17):
        assert latest.offer(make_state(0, session=f"s{number}"), number * 1.0) is None
    assert reason_of(latest, make_state(0, session="s1"), 20.0) is Reason.DUPLICATE
    assert reason_of(latest, make_state(1, session="s1"), 21.0) is None


def test_a_session_that_is_heard_again_is_remembered_longest():
    latest = LatestState()
    for number in range(16):
        latest.offer(make_state(0, session=f"s{number}"), number * 1.0)
    latest.offer(make_state(1, session="s0"), 16.0)
    latest.offer(make_state(0, session="new"), 17.0)
    assert reason_of(latest, make_state(1, session="s0"), 18.0) is Reason.DUPLICATE
    assert reason_of(latest, make_state(2, session="s0"), 19.0) is None
    assert reason_of(latest, make_state(2, session="s1"), 20.0) is Reason.STALE


@pytest.mark.parametrize("take_overs", [17, 100, 2000])
def test_no_number_of_take_overs_makes_an_old_session_new(take_overs):
    latest = LatestState()
    latest.offer(make_state(0, session="old"), 0.0)
    for number in range(take_overs):
        assert latest.offer(make_state(0, session=f"s{number}"), 1.0 + number) is None
    for step in (0, 1, 10**9):
        state = make_state(step, session="old", episode=step)
        assert reason_of(latest, state, 10.0 + take_overs) is Reason.STALE
    assert reason_of(latest, make_state(0, session="new"), 20.0 + take_overs) is None


def test_too_many_sessions_end_in_no_new_one_rather_than_in_an_old_one(monkeypatch):
    monkeypatch.setattr(latest_module, "MAX_FORGOTTEN_SESSIONS", 3)
    latest = LatestState()
    for number in range(19):
        assert latest.offer(make_state(0, session=f"s{number}"), number * 1.0) is None
    rejection = latest.offer(make_state(0, session="s19"), 30.0)
    assert rejection is not None
    assert (rejection.reason, "start the runtime again" in rejection.detail) == (
        Reason.FOREIGN_SESSION,
        True,
    )
    assert reason_of(latest, make_state(1, session="s18"), 31.0) is None  # it goes on
    assert reason_of(latest, make_state(0, session="s0"), 32.0) is Reason.STALE


messages = st.tuples(
    st.sampled_from(["a", "b", "c"]), st.integers(0, 3), st.integers(0, 5), st.floats(0, 0.3)
)


@given(st.lists(messages, max_size=60))
def test_never_backwards(history):
    """Whatever arrives: within a session the accepted states rise, and each message is counted."""
    latest, now_s = LatestState(), 0.0
    reached: dict = {}
    heard: dict = {}
    current = None
    for session, episode, step, pause_s in history:
        now_s += pause_s
        state = make_state(step, session=session, episode=episode)
        if latest.offer(state, now_s) is None:
            assert (episode, step) > reached.get(session, (-1, -1))
            assert current in (None, session) or now_s - heard[current] >= TAKEOVER_SILENCE_S
            reached[session] = (episode, step)
            current = session
        heard[session] = now_s
    assert latest.accepted + sum(latest.rejected.values()) == len(history)
