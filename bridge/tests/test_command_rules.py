"""The vehicle's side of the safety rules: what is believed, held, and braked for."""

from __future__ import annotations

import pytest

from bridge.command_check import CommandCheck
from bridge.safe_stops import SafeStopLog
from bridge.tests.commands import make_command
from edge_runtime.latency.command_hold import NO_COMMAND, CommandHold
from edge_runtime.wire import encode


def checking(newest_step=5):
    check = CommandCheck("here", action_size=1)
    check.begin(0)
    check.sent(newest_step)
    return check


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x00", "malformed"),
        (bytes(70_000), "oversized"),
        (encode(make_command(5, schema=2)), "schema"),
        (encode(make_command(5, action=[float("nan")])), "not_finite"),
        (encode(make_command(5, action=[1.5])), "malformed"),
        (encode(make_command(5, session="elsewhere")), "foreign_session"),
        (encode(make_command(5, action=[0.1, 0.1])), "action_size"),
        (encode(make_command(5, action=[])), "malformed"),
        (encode(make_command(6)), "unknown_step"),
        (encode(make_command(0, episode=1)), "unknown_step"),
    ],
)
def test_a_command_that_answers_nothing_is_counted_by_reason(payload, reason):
    check = checking()
    assert check.read(payload) is None
    assert dict(check.rejected) == {reason: 1}


def test_a_good_command_passes_and_names_the_policy():
    check = checking()
    command = make_command(5, policy_id="abc")
    assert check.read(encode(command)) == command
    assert (check.policy_ids, dict(check.rejected)) == (["abc"], {})


def test_an_earlier_episode_is_stale_but_an_overtaken_answer_is_no_fault():
    check = checking(newest_step=5)
    check.end(final_step=6, answered_step=4)
    check.begin(1)
    assert check.read(encode(make_command(5))) is None
    assert check.read(encode(make_command(6))) is None
    assert dict(check.rejected) == {}
    assert check.read(encode(make_command(3))) is None
    assert dict(check.rejected) == {"stale": 1}


def test_the_newest_command_is_held_for_2_periods_and_no_longer():
    hold = CommandHold(now_s=0.0)
    assert hold.admit(make_command(0), now_s=0.01, sent_s=0.01)
    assert hold.decide(0.025).brake_reason == ""
    held = hold.decide(0.2)
    assert (held.brake_reason, held.fresh, held.command) == ("", False, make_command(0))
    braking = hold.decide(0.22)
    assert braking.brake_reason == NO_COMMAND
    assert braking.undriven_s == pytest.approx(0.21)
    assert braking.command_age_s is None  # It obeys none.


def test_a_command_is_as_old_as_the_state_that_it_answers():
    hold = CommandHold(now_s=0.0)
    assert hold.decide(0.025).command_age_s is None
    hold.admit(make_command(0), now_s=0.06, sent_s=0.0)
    assert hold.decide(0.125).command_age_s == pytest.approx(0.125)
    assert hold.decide(0.225).command_age_s == pytest.approx(0.225)


def test_without_any_command_it_brakes_after_2_periods():
    hold = CommandHold(now_s=5.0)
    assert hold.decide(5.2).brake_reason == ""
    assert hold.decide(5.201).brake_reason == NO_COMMAND


def test_a_repeated_drive_command_is_no_heartbeat_but_a_repeated_safe_stop_is():
    hold = CommandHold(now_s=0.0)
    assert hold.admit(make_command(3), now_s=0.0, sent_s=0.0)
    assert not hold.admit(make_command(3), now_s=0.1, sent_s=0.1)
    assert not hold.admit(make_command(2), now_s=0.1, sent_s=0.1)
    stop = make_command(3, mode="safe_stop", reason="no_fresh_state")
    assert hold.admit(stop, now_s=0.15, sent_s=0.15)
    assert hold.admit(stop, now_s=0.25, sent_s=0.25)
    assert hold.decide(0.4).brake_reason == "no_fresh_state"


def test_lock_step_brakes_at_once_when_the_edge_is_silent():
    hold = CommandHold(now_s=0.0)
    hold.admit(make_command(0), now_s=0.0, sent_s=0.0)
    decision = hold.decide(0.025, edge_silence_s=0.21)
    assert (decision.brake_reason, decision.undriven_s) == (NO_COMMAND, 0.21)


def decisions(*reasons):
    """Decisions of a hold that is silent in the ticks with a reason."""
    hold = CommandHold(now_s=0.0)
    return [hold.decide(0.0, 0.25 if reason else None) for reason in reasons]


def test_one_stretch_of_braking_is_one_event():
    log = SafeStopLog(period_s=0.1)
    speeds = [4.0, 3.0, 0.0, 0.0, 1.0, 0.5]
    braking = decisions("", "x", "x", "x", "", "x")
    for step, (decision, speed) in enumerate(zip(braking, speeds, strict=True)):
        log.observe(7, step, decision, speed)
    first, second = log.events
    assert (first.episode, first.step, first.reason) == (7, 1, NO_COMMAND)
    assert (first.brake_after_s, first.stopped_after_s, first.resumed_after_s) == (0.25, 0.2, 0.3)
    assert (second.step, second.stopped_after_s, second.resumed_after_s) == (5, None, None)


def test_a_new_episode_closes_the_event_of_the_last():
    log = SafeStopLog(period_s=0.1)
    (braking,) = decisions("x")
    log.observe(0, 9, braking, 1.0)
    log.observe(1, 0, braking, 1.0)
    assert [(event.episode, event.resumed_after_s) for event in log.events] == [
        (0, None),
        (1, None),
    ]
