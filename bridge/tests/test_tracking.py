"""Tracking error and lag of vehicles whose dead time and response are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bridge.tests.commands import make_command, make_feedback
from bridge.tracking import LAG_STEP_S, TrackingLog

T_S, REPORT_S = 0.1, 0.05
STEPS = 120


def asked_at(step):
    """A pedal that wanders like a policy's, float in [-1, 1]."""
    return float(np.clip(0.7 * math.sin(0.31 * step) + 0.5 * math.sin(0.113 * step), -1, 1))


def ns(time_s):
    return round((5.0 + time_s) * 1e9)


def log_of(reached, episodes=2):
    """The log of a vehicle that has reached ``reached(t)`` at t, in each of the episodes."""
    log = TrackingLog()
    for episode in range(episodes):
        zero_s = 100.0 * episode
        log.begin()
        for step in range(STEPS):
            stamp = ns(zero_s + step * T_S)
            log.command(make_command(step, action=[asked_at(step)], sent_ns=stamp))
        for number in range(int(STEPS * T_S / REPORT_S)):
            time_s = number * REPORT_S + 0.013
            feedback = make_feedback(0, action=[reached(time_s)], sent_ns=ns(zero_s + time_s))
            log.feedback(feedback)
        log.end()
    return log


def held(time_s):
    return asked_at(min(int(time_s / T_S), STEPS - 1)) if time_s >= 0 else -1.0


def follower(dead_s, constant_s):
    """What a first-order actuator behind a dead time has reached at each time."""
    step_s = 0.001
    value, values = -1.0, []
    for index in range(int(STEPS * T_S / step_s) + 100):
        target = held(index * step_s - dead_s)
        value += (target - value) * (1 - math.exp(-step_s / constant_s))
        values.append(value)
    return lambda time_s: values[round(time_s / step_s)]


@pytest.mark.parametrize("delay_s", [0.0, 0.06, 0.155, 0.4])
def test_a_delay_is_found(delay_s):
    report = log_of(lambda time_s: held(time_s - delay_s)).report(["pedal"])
    # Asked and reached are steps here: all delays between two reports are as good.
    assert report["lag_ms"]["pedal"] == pytest.approx(delay_s * 1e3, abs=REPORT_S / 2 * 1e3)


@pytest.mark.parametrize(("dead_s", "constant_s"), [(0.02, 0.05), (0.1, 0.1), (0.2, 0.3)])
def test_a_lag_lies_between_the_dead_time_and_its_sum_with_the_time_constant(dead_s, constant_s):
    lag_s = log_of(follower(dead_s, constant_s)).report(["pedal"])["lag_ms"]["pedal"] / 1e3
    half_s = REPORT_S / 2
    assert dead_s + 0.5 * constant_s - half_s < lag_s < dead_s + constant_s + half_s


def test_an_error_is_what_was_asked_then_with_the_lag_in_it():
    exact = log_of(held).report(["pedal"])["action_error"]["pedal"]
    assert exact == {"rmse": 0.0, "max": 0.0}
    off = log_of(lambda time_s: held(time_s) - 0.25).report(["pedal"])["action_error"]["pedal"]
    assert off == {"rmse": pytest.approx(0.25), "max": pytest.approx(0.25)}


def test_a_speed_is_compared_with_its_set_point_at_the_same_moment():
    log = TrackingLog()
    log.begin()
    for number in range(200):
        time_s = number * REPORT_S
        asked, reached = (1 + math.sin(2 * (time_s - lag_s)) for lag_s in (0.0, 0.2))
        log.feedback(
            make_feedback(
                0, sent_ns=ns(time_s), speed_mps=reached, commanded_speed_mps=asked,
                scenario_speed_mps=4 * reached,
            )
        )  # fmt: skip
    report = log.report([])
    assert report["lag_ms"] == {"speed": pytest.approx(200, abs=1e3 * LAG_STEP_S)}
    assert report["speed_error_mps"]["max"] == pytest.approx(2 * math.sin(0.2), abs=0.01)
    assert report["scale"] == pytest.approx(0.25)


def test_what_was_not_measured_is_none():
    log = log_of(lambda time_s: 0.5)
    report = log.report(["pedal"])
    assert report["speed_error_mps"] == {"rmse": None, "max": None}
    assert report["lag_ms"]["speed"] is None
    assert report["scale"] is None
    nothing = TrackingLog().report(["pedal"])
    assert nothing["action_error"] == {"pedal": {"rmse": None, "max": None}}
    assert nothing["lag_ms"] == {"speed": None, "pedal": None}


def test_who_is_asked_nothing_new_shows_no_lag():
    log = TrackingLog()
    log.begin()
    for step in range(50):
        log.command(make_command(step, action=[0.5], sent_ns=ns(step * T_S)))
        log.feedback(make_feedback(step, action=[0.5], sent_ns=ns(step * T_S + 0.02)))
    assert log.report(["pedal"])["lag_ms"]["pedal"] is None


def test_a_vehicle_that_brakes_by_itself_or_between_episodes_makes_no_error():
    log = log_of(held, episodes=1)
    log.feedback(make_feedback(0, action=[-1.0], sent_ns=ns(50.0), faults=["unheard"]))
    log.begin()
    log.command(make_command(0, action=[0.5], sent_ns=ns(60.0)))
    log.feedback(
        make_feedback(0, action=[-1.0], sent_ns=ns(60.1), self_braking=True, faults=["low battery"])
    )
    report = log.report(["pedal"])
    assert report["action_error"]["pedal"]["max"] == 0.0
    assert report["faults"] == {"low battery": 1}


def test_stamps_of_a_clock_that_was_stepped_do_no_harm():
    log = TrackingLog()
    log.begin()
    for step in range(20):
        stamp = ns(step * T_S if step < 10 else -50 + step * T_S)
        log.command(make_command(step, action=[asked_at(step)], sent_ns=stamp))
        log.feedback(make_feedback(step, action=[asked_at(step)], sent_ns=stamp + 1))
    assert log.report(["pedal"])["action_error"]["pedal"]["max"] == 0.0


def test_the_words_of_faults_are_counted_and_bounded():
    log = TrackingLog()
    log.begin()
    for number in range(100):
        log.feedback(make_feedback(0, faults=[f"fault {number}", "fault 0"]))
    faults = log.report([])["faults"]
    assert len(faults) == 32
    assert faults["fault 0"] == 101
