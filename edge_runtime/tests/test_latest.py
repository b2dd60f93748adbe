from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

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
