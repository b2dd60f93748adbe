"""The vehicle's side of the safety rules: what is believed, held, and braked for."""

from typing import Any
from unittest.mock import Mock, call

import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from bridge import inbound
from bridge.environments import Adapter, describe
from bridge.inbound import NO_COMMAND, CommandHold
from bridge.ports import EdgeStatus
from bridge.report import SafeStopLog
from bridge.simulate import vehicle_action
from bridge.tests.recordings import health
from edge_runtime.manifest import Action
from edge_runtime.wire import encode
from hil_tests.tests.shared.environments import ToyEnv
from hil_tests.tests.shared.messages import make_command, make_feedback
from hil_tests.tests.shared.policies import TASK, T


def checking(task=TASK):
    check = inbound.CommandCheck("here", task)
    check.begin(0)
    check.sent(5)
    return check


def checking_feedback():
    return inbound.FeedbackCheck(checking())


BOTH = [
    ({"schema": 1}, "schema"),
    ({"action": [1.5]}, "action_range"),
    ({"session": "elsewhere"}, "foreign_session"),
    ({"action": [0.1, 0.1]}, "action_size"),
    ({"step": 6}, "unknown_step"),
    ({"step": 0, "episode": 1}, "unknown_step"),
]
PLANS = [
    ({"plan": [[0.5], [1.5]]}, "action_range"),
    ({"plan": [[0.5, 0.5]]}, "malformed"),
    ({"plan": [[0.5]] * 11}, "malformed"),
]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [*BOTH, *PLANS, ({"action": [float("nan")]}, "not_finite"),
     ({"action": []}, "malformed"), (b"\x00", "malformed"), (bytes(70_000), "oversized")],
)  # fmt: skip
def test_a_command_that_answers_nothing_is_counted_by_reason(changes, reason):
    bad = changes if isinstance(changes, bytes) else encode(make_command(**{"step": 5} | changes))
    check, good = checking(), make_command(5, policy_id="abc")
    assert check.read(bad) is None
    assert check.read(encode(good)) == good
    assert (check.policy_ids, dict(check.rejected)) == (["abc"], {reason: 1})


@pytest.mark.parametrize("action", [[], [0.1, 0.1], [7.0]])
def test_a_stop_is_one_by_its_mode_whatever_action_it_carries(action):
    check, stop = checking(), make_command(5, mode="safe_stop", reason="other_task", action=action)
    assert check.read(encode(stop)) == msgspec.structs.replace(stop, action=[-1.0])
    assert not check.rejected
    fits = msgspec.structs.replace(stop, action=[-0.9], sent_ns=stop.sent_ns + 1)
    assert check.read(encode(fits)) == fits
    assert check.read(encode(msgspec.structs.replace(fits, plan=[[0.5]] * 99))) == fits


def test_an_answer_after_its_episodes_end_is_not_taken_and_no_fault():
    check = checking()
    check.end(final_step=6)
    for _ in range(2):
        assert [check.read(encode(make_command(step))) for step in (3, 5, 6)] == [None] * 3
        check.begin(1)
    assert not check.rejected


def test_the_newest_command_is_held_for_2_periods_and_no_longer():
    hold = CommandHold(0.0, T)
    assert hold.admit(make_command(0), now_s=0.01)
    assert hold.decide(0.025).brake_reason == ""
    held, braking = hold.decide(0.2), hold.decide(0.22)
    assert (held.brake_reason, held.fresh, held.command) == ("", False, make_command(0))
    assert braking.brake_reason == NO_COMMAND
    # Without any command it brakes as late.
    hold = CommandHold(5.0, T)
    assert [hold.decide(now_s).brake_reason for now_s in (5.2, 5.201)] == ["", NO_COMMAND]


@given(plan=st.lists(st.floats(-1, 1), max_size=10), now_s=st.lists(st.floats(0, 3), max_size=40))
def test_a_plan_is_played_period_by_period_and_no_longer_than_it_says(plan, now_s):
    further = [[value] for value in plan]
    hold = CommandHold(0.0, T)
    hold.admit(make_command(0, action=[0.2], plan=further), now_s=0.0)
    for at_s in sorted(now_s):
        found = hold.decide(at_s)
        rides_s = 2 * T + len(plan) * T + 1e-9
        assert (found.brake_reason == NO_COMMAND) == (at_s > rides_s)
        if not found.brake_reason:
            place = min(int((at_s + 1e-9) / T), len(plan))
            assert found.ridden == place
            assert found.command is not None
            assert found.command.action == [[0.2], *further][place]
    # Whatever it rides on, a stop and a newer command end it at once, and it waits for no plan.
    last_s = max(now_s, default=0.0)
    hold.admit(make_command(1, mode="safe_stop", reason="vehicle_fault", plan=further), last_s)
    stopped = hold.decide(last_s)
    assert (stopped.brake_reason, stopped.ridden) == ("vehicle_fault", 0)
    hold.admit(make_command(2, action=[-0.5]), last_s)
    newer, late = hold.decide(last_s), hold.decide(last_s + 2.1 * T)
    assert newer.command == make_command(2, action=[-0.5])
    assert (newer.ridden, late.brake_reason) == (0, NO_COMMAND)


def test_a_plan_may_last_a_second_whatever_the_period():
    check = checking(msgspec.structs.replace(TASK, control_period_s=0.3))
    taken = [check.read(encode(make_command(5, plan=[[0.1]] * n))) is not None for n in (3, 4)]
    assert (taken, dict(check.rejected)) == ([True, False], {"plan_too_long": 1})


def test_a_repeated_drive_command_is_no_heartbeat_but_a_repeated_safe_stop_is():
    hold = CommandHold(0.0, T)
    stop = make_command(3, mode="safe_stop", reason="no_fresh_state")
    for command, now_s, is_taken in [
        (make_command(3), 0.0, True), (make_command(3), 0.1, False), (make_command(2), 0.1, False),
        (stop, 0.15, True), (stop, 0.25, True),
    ]:  # fmt: skip
        assert hold.admit(command, now_s) is is_taken
    assert hold.decide(0.4).brake_reason == "no_fresh_state"


def decisions(*reasons):
    """Decisions of a hold that is silent in the ticks with a reason."""
    hold = CommandHold(0.0, T)
    return [hold.decide(0.0, bool(reason)) for reason in reasons]


def test_one_stretch_of_braking_is_one_event():
    log = SafeStopLog()
    braking = decisions("", "x", "x", "x", "", "x")
    for step, decision in enumerate(braking):
        log.observe(7, step, decision)
    first, second = log.events
    assert (first.episode, first.step, first.reason) == (7, 1, NO_COMMAND)
    assert second.step == 5
    log.observe(8, 0, braking[-1])  # A new episode closes the event of the last.
    assert [one.episode for one in log.events] == [7, 7, 8]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [*BOTH, ({"speed_mps": float("nan")}, "not_finite"), ({"action": [1.01]}, "action_range"),
     ({"scenario_speed_mps": float("inf")}, "not_finite"), ({"step": 4}, "duplicate"),
     ({"step": 3}, "stale"), (b"\x00", "malformed"), (bytes(70_000), "oversized")],
)  # fmt: skip
def test_feedback_that_cannot_be_believed_is_counted_by_reason(changes, reason):
    bad = changes if isinstance(changes, bytes) else encode(make_feedback(**{"step": 5} | changes))
    check, believed = checking_feedback(), make_feedback(4)
    assert check.read(encode(believed), now_s=0.0) == believed
    assert check.read(bad, now_s=0.05) is None
    assert dict(check.commands.rejected) == {f"feedback_{reason}": 1}


def test_a_vehicle_that_answers_the_last_simulator_is_there_but_not_believed():
    check = checking_feedback()
    before = make_feedback(900, session="the one before")
    assert check.read(encode(before), now_s=0.0) is None
    assert (check.heard, dict(check.commands.rejected)) == (before, {})
    uncommanded = make_feedback(-1, session="", episode=-1)
    assert check.read(encode(uncommanded), now_s=0.1) == uncommanded


def test_after_silence_another_board_with_a_slow_clock_is_believed():
    check = checking_feedback()
    check.read(encode(make_feedback(5)), now_s=0.0)
    early = encode(make_feedback(-1, session="", episode=-1, sent_ns=7))
    assert check.read(early, now_s=0.15) is None
    assert check.read(early, now_s=0.25) is not None
    assert dict(check.commands.rejected) == {"feedback_stale": 1}


MANIFEST: Any = None  # Nobody looks at it.
HEARD = CommandHold(0.0, T).decide(0.0)
STOPPED = CommandHold(0.0, T).decide(0.0, edge_silent=True)


def decide(feedback, after_s=0.05, heard=HEARD):
    check = checking_feedback()
    check._newest, check._newest_s = feedback, 1.0
    return check.decide(heard, 0, now_s=1.0 + after_s)


def test_feedback_holds_for_2_periods_and_no_longer():
    held = decide(make_feedback(3), after_s=0.2)
    assert (held.brake_reason, held.feedback) == ("", make_feedback(3))
    silent = decide(make_feedback(3), after_s=0.21)
    assert (silent.brake_reason, silent.feedback) == (inbound.NO_FEEDBACK, None)


@pytest.mark.parametrize(
    ("feedback", "heard", "reason"),
    [
        (make_feedback(3), STOPPED, ""),  # The vehicle is believed, not what it was told.
        (make_feedback(3, mode="safe_stop"), STOPPED, NO_COMMAND),
        (make_feedback(3, mode="safe_stop"), HEARD, "safe_stop"),
        (make_feedback(3, self_braking=True), HEARD, inbound.SELF_BRAKING),
        # It still stands after the last episode.
        (make_feedback(3, episode=-1, mode="safe_stop", self_braking=True), HEARD, ""),
        (make_feedback(3, episode=-1, self_braking=True), STOPPED, NO_COMMAND),
    ],
)
def test_why_the_vehicle_brakes(feedback, heard, reason):
    assert decide(feedback, heard=heard).brake_reason == reason


class PedalEnv(ToyEnv):
    def pedal_for_speed(self, speed_mps):
        return 0.125 * speed_mps


@pytest.mark.parametrize(
    ("environment", "names", "changes", "applied"),
    [
        (ToyEnv, "pedal", {"action": [0.25]}, [0.25]),
        (ToyEnv, "pedal", {"action": [0.25], "scenario_speed_mps": 2.0}, [0.25]),
        (PedalEnv, "pedal", {"action": [0.5], "scenario_speed_mps": 2.0}, [0.25]),
        (PedalEnv, "pedal", {"scenario_speed_mps": 2.0, "mode": "safe_stop"}, [0.25]),
        # A pedal takes its own place only.
        (PedalEnv, "x pedal", {"action": [0.7, 0.5], "scenario_speed_mps": 2.0}, [0.7, 0.25]),
    ],
)
def test_the_car_does_what_the_vehicle_did(environment, names, changes, applied):
    env, rows = environment(), [Action(name=name, low=-1, high=1) for name in names.split()]
    task = msgspec.structs.replace(describe(env), action=rows)
    env.action_space = spaces.Box(-1.0, 1.0, (len(rows),), np.float32)
    action = vehicle_action(Adapter(env, task), decide(make_feedback(3, **changes)))
    assert (action.dtype, action.tolist()) == (np.float32, pytest.approx(applied))


def test_a_steered_car_brakes_when_its_vehicle_does():
    environment: Any = ToyEnv()
    environment.press_brake, environment.brake_action = Mock(), np.array([0.1], np.float32)
    adapter = Adapter(environment, describe(environment))
    stop = decide(make_feedback(3, mode="safe_stop", action=[0.5]))
    silent = decide(make_feedback(3), after_s=1.0)
    for decision, action in ((stop, 0.5), (decide(make_feedback(3)), 0.5), (silent, 0.1)):
        assert vehicle_action(adapter, decision).tolist() == [pytest.approx(action)]
    assert environment.press_brake.call_args_list == [call(True), call(False), call(True)]


@pytest.mark.parametrize(
    ("before", "after", "grown"),
    [
        (health(1, 1.0, stale=7), health(2, 2.0, stale=9, schema=1), {"stale": 2, "schema": 1}),
        # Restarted: it counts from zero, even where it has passed the old count.
        (health(1, 9.0, stale=1), health(2, 0.5, stale=3), {"stale": 3}),
        # The board's wall clock was set back in between.
        (health(9, 1.0, stale=1), health(2, 2.0, stale=3), {"stale": 2}),
    ],
)
def test_what_an_edge_runtime_rejected_in_a_drive_is_the_growth_of_its_counts(before, after, grown):
    first, last = (
        EdgeStatus(**msgspec.structs.asdict(one), manifest=MANIFEST) for one in (before, after)
    )
    assert last.rejected_since(first) == grown
