"""The take-over as a state machine: no jumps, at once, and every step that is not the policy's."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from trainer.person.interface import Moving, Reading
from trainer.person.takeover import MAX_SLEW, NEXT, Intent, TakeOver

ACTION = st.floats(-1.0, 1.0)
STEPS = st.lists(st.tuples(ACTION, ACTION, st.booleans()), min_size=1, max_size=60)
EPSILON = 1e-12


@given(STEPS)
def test_a_hand_over_never_jumps_and_all_but_the_policys_own_action_is_the_persons(steps):
    """Within a hand-over and at both of its ends the action moves by at most the slew."""
    take_over, last, before = TakeOver(), None, "policy"
    for policy, human, holds in steps:
        applied = take_over.step(policy, human, holds)
        followed = before == take_over.state in ("policy", "human")
        if last is not None and not followed:
            assert abs(applied.action - last) <= MAX_SLEW + EPSILON
        # An intervention has one first step, which already moves towards the person.
        assert applied.first == (applied.human and before == "policy")
        if applied.first:
            start = policy if last is None else last
            assert abs(human - applied.action) <= max(abs(human - start) - MAX_SLEW, 0.0) + EPSILON
        assert applied.human or (applied.action == policy and not holds)
        last, before = applied.action, take_over.state


@given(STEPS, ACTION, ACTION)
def test_whoever_holds_or_lets_go_for_long_is_followed_exactly(steps, policy, human):
    take_over = TakeOver()
    for step in steps:
        take_over.step(*step)
    for action, control in ((human, "human"), (policy, "policy")):
        for _ in range(4):
            applied = take_over.step(policy, human, control == "human")
        decided = (applied.action, applied.control, applied.human)
        assert decided == (action, control, control == "human")


def test_the_table_has_every_row():
    states = {state for state, _, _ in NEXT}
    assert len(NEXT) == 4 * len(states)
    assert set(NEXT.values()) == states


def test_on_the_way_back_the_steps_are_the_persons():
    take_over = TakeOver()
    take_over.step(1.0, -1.0, True)
    take_over.step(1.0, -1.0, True)
    back = [take_over.step(1.0, -1.0, False) for _ in range(4)]
    assert [b.action for b in back] == [0.5, 1.0, 1.0, 1.0]
    assert [b.control for b in back] == ["returning", "policy", "policy", "policy"]
    assert [b.human for b in back] == [True, False, False, False]


def wheel(action):
    return Reading(action=action, by_moving=True)


def test_moving_the_wheel_takes_over_and_resting_gives_back():
    intent = Intent(Moving(threshold=0.15, rest=0.05, rest_s=0.6))
    assert not intent.update(wheel(0.1), 0.0)
    assert intent.update(wheel(0.2), 0.1)
    assert intent.update(wheel(0.1), 0.2)
    # Through the middle and out again: still in the person's hands.
    assert intent.update(wheel(0.0), 0.3)
    assert intent.update(wheel(-0.1), 0.7)
    assert intent.update(wheel(0.01), 0.8)
    assert intent.update(wheel(0.01), 1.3)
    assert not intent.update(wheel(0.01), 1.5)
    assert not intent.update(wheel(0.1), 1.6)


def test_a_device_that_takes_over_by_holding_is_not_moved_and_one_that_is_gone_lets_go():
    intent = Intent(Moving())
    assert not intent.update(Reading(action=1.0), 0.0)
    assert intent.update(Reading(action=0.0, engaged=True), 0.1)
    assert intent.update(wheel(1.0), 0.2)
    assert not intent.update(Reading(), 0.3)


@given(st.lists(st.tuples(st.floats(-0.15, 0.15), st.floats(0.0, 1.0)), max_size=30))
def test_below_the_threshold_nothing_is_taken_over(moves):
    intent, now_s = Intent(Moving()), 0.0
    for action, waited_s in moves:
        now_s += waited_s
        assert not intent.update(wheel(action), now_s)
