"""A vehicle in the loop: which feedback is believed, for how long, and what the car does by it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.actions import vehicle_action
from bridge.feedback_check import FeedbackCheck
from bridge.feedback_hold import NO_FEEDBACK, SELF_BRAKING, FeedbackHold, VehicleDecision
from bridge.tests.commands import make_command, make_feedback
from bridge.tests.toy import ToyEnv
from edge_runtime.latency.command_hold import NO_COMMAND, CommandHold
from edge_runtime.wire import encode


def checking(newest_step=5):
    check = FeedbackCheck("here", action_size=1)
    check.sent(0, newest_step)
    return check


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x00", "malformed"),
        (bytes(70_000), "oversized"),
        (encode(make_feedback(5, schema=2)), "schema"),
        (encode(make_feedback(5, speed_mps=float("nan"))), "not_finite"),
        (encode(make_feedback(5, scenario_speed_mps=float("inf"))), "not_finite"),
        (encode(make_feedback(5, session="elsewhere")), "foreign_session"),
        (encode(make_feedback(5, action=[0.1, 0.1])), "action_size"),
        (encode(make_feedback(5, action=[1.01])), "action_range"),
        (encode(make_feedback(6)), "unknown_step"),
        (encode(make_feedback(0, episode=1)), "unknown_step"),
        (encode(make_feedback(4)), "duplicate"),
        (encode(make_feedback(3)), "stale"),
    ],
)
def test_feedback_that_cannot_be_believed_is_counted_by_reason(payload, reason):
    check = checking()
    believed = make_feedback(4)
    assert check.read(encode(believed), now_s=0.0) == believed
    assert check.read(payload, now_s=0.05) is None
    assert dict(check.rejected) == {reason: 1}


@given(st.binary(max_size=300))
def test_no_bytes_raise_or_are_believed_by_chance(payload):
    check = checking()
    assert check.read(payload, now_s=0.0) is None
    assert sum(check.rejected.values()) == 1


def test_a_vehicle_that_answers_the_last_simulator_is_there_but_not_believed():
    check = checking()
    before = make_feedback(900, session="the one before")
    assert check.read(encode(before), now_s=0.0) is None
    assert (check.heard, dict(check.rejected)) == (before, {})
    uncommanded = make_feedback(-1, session="", episode=-1)
    assert check.read(encode(uncommanded), now_s=0.1) == uncommanded


def test_after_silence_another_board_with_a_slow_clock_is_believed():
    check = checking()
    check.read(encode(make_feedback(5)), now_s=0.0)
    early = encode(make_feedback(-1, session="", episode=-1, sent_ns=7))
    assert check.read(early, now_s=0.15) is None
    assert check.read(early, now_s=0.25) is not None
    assert dict(check.rejected) == {"stale": 1}


HEARD = CommandHold(now_s=0.0).decide(0.0)
STOPPED = CommandHold(now_s=0.0).decide(0.0, edge_silence_s=0.3)


def decide(feedback, after_s=0.05, heard=HEARD, episode=0):
    hold = FeedbackHold(now_s=0.0)
    hold.admit(feedback, received_s=1.0, now_s=1.0)
    return hold.decide(heard, episode, now_s=1.0 + after_s)


def test_feedback_holds_for_2_periods_and_no_longer():
    held = decide(make_feedback(3), after_s=0.2)
    assert (held.brake_reason, held.feedback) == ("", make_feedback(3))
    assert held.feedback_age_s == pytest.approx(0.2)
    silent = decide(make_feedback(3), after_s=0.21)
    assert (silent.brake_reason, silent.feedback) == (NO_FEEDBACK, None)


def test_a_delay_on_the_way_makes_feedback_older_and_the_vehicle_not_silent():
    hold = FeedbackHold(now_s=0.0)
    hold.admit(make_feedback(3), received_s=1.0, now_s=1.3)
    decision = hold.decide(HEARD, 0, now_s=1.35)
    assert decision.brake_reason == ""
    assert decision.feedback_age_s == pytest.approx(0.35)


@pytest.mark.parametrize(
    ("feedback", "heard", "reason"),
    [
        (make_feedback(3), STOPPED, ""),  # The vehicle is believed, not what it was told.
        (make_feedback(3, mode="safe_stop"), STOPPED, NO_COMMAND),
        (make_feedback(3, mode="safe_stop"), HEARD, "safe_stop"),
        (make_feedback(3, self_braking=True), HEARD, SELF_BRAKING),
        # It still stands after the last episode.
        (make_feedback(3, episode=-1, mode="safe_stop", self_braking=True), HEARD, ""),
        (make_feedback(3, episode=-1, self_braking=True), STOPPED, NO_COMMAND),
    ],
)
def test_why_the_vehicle_brakes(feedback, heard, reason):
    assert decide(feedback, heard=heard).brake_reason == reason


class PedalEnv(ToyEnv):
    """The toy, and which pedal it takes to a speed."""

    def pedal_for_speed(self, speed_mps):
        return 0.125 * speed_mps


@pytest.mark.parametrize(
    ("environment", "changes", "applied"),
    [
        (ToyEnv(), {"action": [0.25]}, 0.25),
        (ToyEnv(), {"action": [1.0009]}, 1.0),
        (ToyEnv(), {"action": [0.25], "scenario_speed_mps": 2.0}, 0.25),
        (PedalEnv(), {"action": [0.5]}, 0.5),
        (PedalEnv(), {"action": [0.5], "scenario_speed_mps": 2.0}, 0.25),
        (PedalEnv(), {"action": [0.5], "scenario_speed_mps": 2.0, "mode": "safe_stop"}, 0.25),
    ],
)
def test_the_car_does_what_the_vehicle_did(environment, changes, applied):
    apply = vehicle_action(["pedal"])
    action = apply(environment, decide(make_feedback(3, **changes)))
    assert (action.dtype, action.tolist()) == (np.float32, [applied])


def test_a_pedal_takes_its_own_place_only():
    apply = vehicle_action(["steering", "pedal"])
    feedback = make_feedback(3, action=[0.75, 0.5], scenario_speed_mps=2.0)
    assert apply(PedalEnv(), decide(feedback)).tolist() == [0.75, 0.25]
    assert vehicle_action(["steering"])(
        PedalEnv(), decide(make_feedback(3, action=[0.75], scenario_speed_mps=2.0))
    ).tolist() == [0.75]


class SteeredEnv(ToyEnv):
    """The toy, steered: its brake is beside the action."""

    def __init__(self):
        super().__init__()
        self.pressed = []
        self.brake_action = np.array([0.1], np.float32)

    def press_brake(self, pressed):
        self.pressed.append(pressed)


def test_a_steered_car_brakes_when_its_vehicle_does():
    environment, apply = SteeredEnv(), vehicle_action(["steering"])
    stop = decide(make_feedback(3, mode="safe_stop", action=[0.5]))
    assert apply(environment, stop).tolist() == [0.5]
    assert apply(environment, decide(make_feedback(3))).tolist() == [0.5]
    silent = decide(make_feedback(3), after_s=1.0)
    assert apply(environment, silent).tolist() == [pytest.approx(0.1)]
    assert environment.pressed == [True, False, True]
    assert isinstance(silent, VehicleDecision)


def test_a_command_that_nobody_obeys_has_no_age():
    hold = CommandHold(now_s=0.0)
    hold.admit(make_command(3), now_s=0.0, sent_s=0.0)
    heard = hold.decide(0.05)
    assert decide(make_feedback(3), heard=heard).command_age_s == heard.command_age_s
    assert decide(make_feedback(3, mode="safe_stop"), heard=heard).command_age_s is None
    assert decide(make_feedback(3), after_s=1.0, heard=heard).command_age_s is None
