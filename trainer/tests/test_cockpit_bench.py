"""Which recorded step answers which key."""

import pytest

from trainer.benches.cockpit import key_to_applied_ms, quantiles
from trainer.person.recording import Step


def steps(marks):
    """Steps every 100 ms: ``.`` the policy's, ``F`` an intervention's first, ``E`` an end."""
    return [step(number, mark) for number, mark in enumerate(marks)]


def step(number, mark):
    return Step(
        sitting=1,
        index=number,
        scenario="left_turn",
        seed=0,
        episode=0,
        step=number,
        time_ns=number * 100_000_000,
        time_s=0.1 * number,
        frames=b"",
        next_frame=b"",
        policy_action=0.0,
        human_action=0.0,
        action=0.0,
        control="human" if mark in "Fh" else "policy",
        human=mark in "Fh",
        first=mark == "F",
        reward=0.0,
        terminated=mark == "E",
        truncated=False,
        speed_mps=0.0,
        outcome="goal" if mark == "E" else "",
    )


def latencies(marks, *downs_ms):
    return key_to_applied_ms([1e6 * down_ms for down_ms in downs_ms], steps(marks))


def test_a_press_is_answered_by_the_next_step_that_begins_an_intervention():
    assert latencies("..Fh...F.", 130, 601) == pytest.approx([70.0, 99.0])


def test_a_press_that_nothing_answered_is_charged_until_something_does():
    assert latencies("......F", 130) == pytest.approx([470.0])


def test_an_episodes_end_before_the_answer_is_not_counted():
    assert latencies("..E.F", 130) == [None]


def test_a_press_between_two_episodes_or_after_the_last_is_not_counted():
    assert latencies("..E..F", 230) == [None]
    assert latencies("...", 150) == [None]
    assert latencies("", 150) == [None]


def test_quantiles():
    assert quantiles([1.0, 2.0, 3.0]) == pytest.approx(
        {"p50": 2.0, "p90": 2.8, "p99": 2.98, "max": 3.0}
    )
