from collections import Counter

import pytest
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import T
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime import latest as latest_module
from edge_runtime.latest import LatestState
from edge_runtime.wire import Reason


def reason_of(latest, state, now_s):
    rejection = latest.offer(state, now_s)
    return rejection and rejection.reason


A, B = "simulator-a", "simulator-b"
DUPLICATE, STALE = Reason.DUPLICATE, Reason.STALE
FUTURE, FOREIGN = Reason.FUTURE, Reason.FOREIGN_SESSION
# Of each state that comes: session, episode, step, when, and why it is rejected.
STORIES: dict = {
    "old and equal states are rejected": [
        (A, 0, 5, 0.0, None), (A, 0, 5, 0.1, DUPLICATE), (A, 0, 4, 0.1, STALE),
        (A, 1, 0, 0.2, None), (A, 0, 9, 0.3, STALE),
    ],
    "a second simulator waits for silence": [
        (A, 0, 0, 0.0, None), (B, 0, 0, 0.19, FOREIGN), (A, 0, 1, 0.19, None),
        (B, 0, 0, 0.3, FOREIGN), (B, 0, 1, 0.39, None), (A, 0, 2, 0.4, FOREIGN),
    ],
    "a foreign state does not end the silence": [
        (A, 0, 0, 0.0, None), (B, 0, 0, 0.1, FOREIGN), (B, 0, 0, 2 * T, None),
    ],
    "a stale message still shows that its simulator is there": [
        (A, 0, 3, 0.0, None), (A, 0, 3, 0.15, DUPLICATE), (B, 0, 0, 0.25, FOREIGN),
    ],
    "a delayed message of an earlier simulator does not go back": [
        (A, 0, 7, 0.0, None), (B, 0, 0, 1.0, None), (A, 0, 7, 2.0, DUPLICATE), (A, 0, 8, 2.0, None),
    ],
    "no state from further ahead than a simulator can be, and none of them counts": [
        (A, 2, 5, 10.0, None), (A, 2, 10_006, 10.0, FUTURE), (A, 3, 10_001, 10.0, FUTURE),
        (A, 13, 0, 10.0, FUTURE), (A, 2, 6, 10.0, None), (A, 2, 10_006, 10.0, None),
        (A, 12, 10_000, 10.0, None),
    ],
    "a simulator that counts in leaps goes on from where it came to": [
        (A, 0, 5, 0.0, None), (A, 100, 0, 0.1, FUTURE), (A, 101, 1, 0.2, FUTURE),
        (A, 101, 12, 0.3, FUTURE), (A, 101, 12, 0.4, FUTURE), (A, 101, 11, 0.45, FUTURE),
        (A, 101, 12, 0.5, None), (A, 101, 13, 0.5, None),
        (A, 100, 1, 0.6, STALE), (B, 200, 0, 1.0, None), (A, 201, 13, 2.0, FUTURE),
        (B, 201, 0, 2.0, None), (B, 300, 14, 2.1, FUTURE), (B, 300, 24, 2.2, None),
    ],
    "two leaps between which it went on as ever are two strays": [
        (A, 0, 5, 0.0, None), (A, 100, 0, 0.1, FUTURE), (A, 0, 6, 0.2, None),
        (A, 100, 1, 0.3, FUTURE), (A, 0, 7, 0.4, None), (A, 100, 1, 0.5, FUTURE),
        (A, 99, 2, 0.6, FUTURE),
    ],
    "after an outage a simulator may be far ahead": [
        (A, 0, 0, 0.0, None), (A, 0, 20_001, 100.0, FUTURE), (A, 0, 20_000, 100.0, None),
        (A, 31, 0, 120.0, FUTURE), (A, 30, 0, 120.0, None),
    ],
    "the first state of a session may stand anywhere": [(A, 10**9, 10**12, 0.0, None)],
    "past sessions may come back with newer states, and never with older ones": [
        *((f"s{number}", 0, 0, number * 1.0, None) for number in range(2000)),
        ("s1", 0, 0, 2100.0, DUPLICATE), ("s1", 0, 1, 2101.0, None), ("s1", 0, 0, 2102.0, STALE),
        ("s2", 10**9, 10**9, 2102.1, FOREIGN), ("s2", 10**9, 10**9, 2104.0, FUTURE),
    ],
}  # fmt: skip


@pytest.mark.parametrize("story", STORIES)
def test_which_states_are_accepted(story):
    latest, reasons = LatestState(T), [reason for *_, reason in STORIES[story]]
    for session, episode, step, now_s, reason in STORIES[story]:
        state = make_state(step, session=session, episode=episode)
        assert reason_of(latest, state, now_s) is reason, (session, episode, step)
    assert latest.accepted == reasons.count(None)
    assert latest.rejected == Counter(reason.value for reason in reasons if reason)


def test_too_many_sessions_end_in_no_new_one_rather_than_in_an_old_one(monkeypatch):
    monkeypatch.setattr(latest_module, "MAX_SESSIONS", 3)
    latest = LatestState(T)
    for number in range(3):
        assert latest.offer(make_state(0, session=f"s{number}"), number * 1.0) is None
    reason, detail = latest.offer(make_state(0, session="s3"), 30.0) or ("", "")
    assert reason is FOREIGN
    assert "start the runtime again" in detail
    assert reason_of(latest, make_state(1, session="s2"), 31.0) is None  # it goes on
    stale = latest.offer(make_state(0, session="s2"), 32.0)
    assert stale == (STALE, "episode 0 step 0 after episode 0 step 1")
    assert reason_of(latest, make_state(0, session="s0"), 33.0) is DUPLICATE


messages = st.tuples(
    st.sampled_from(["a", "b", "c"]), st.integers(0, 3), st.integers(0, 5), st.floats(0, 0.3)
)


@given(st.lists(messages, max_size=60))
def test_never_backwards(history):
    """Whatever arrives: within a session the accepted states rise, and each message is counted."""
    latest, now_s = LatestState(T), 0.0
    reached: dict = {}
    heard: dict = {}
    current = None
    for session, episode, step, pause_s in history:
        now_s += pause_s
        state = make_state(step, session=session, episode=episode)
        if latest.offer(state, now_s) is None:
            assert (episode, step) > reached.get(session, (-1, -1))
            assert current in (None, session) or now_s - heard[current] >= 2 * T
            reached[session] = (episode, step)
            current = session
        heard[session] = now_s
    assert latest.accepted + sum(latest.rejected.values()) == len(history)
