"""Tracking error and lag of vehicles whose dead time and response are known."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Any

import numpy as np
import pytest

from bridge.clocks import VehicleClock
from bridge.inbound import NO_FEEDBACK, CommandCheck, FeedbackCheck
from bridge.network import parse_spec
from bridge.ports import connect_client
from bridge.report import LAG_STEP_S, TrackingLog
from bridge.tests.harness import (
    SHORT_TOY,
    decoded,
    make_command,
    make_feedback,
    make_policy,
    read,
    start_edge,
    start_simulate,
)
from edge_runtime.tests.harness import PATIENCE_S, make_state, wait_until
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S, Feedback, decode_feedback, encode

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
    for zero_s in (0.0, 100.0)[:episodes]:
        log.begin()
        for step in range(STEPS):
            asked = {"action": [asked_at(step)], "sent_ns": ns(zero_s + step * T_S)}
            log.command(make_command(step, **asked))
        for time_s in np.arange(0.013, STEPS * T_S, REPORT_S):
            stamp = ns(zero_s + time_s)
            log.feedback(make_feedback(0, action=[reached(time_s)], sent_ns=stamp))
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


def begun():
    log = TrackingLog()
    log.begin()
    return log


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
    for off in (0.0, 0.25):
        report = log_of(lambda time_s, off=off: held(time_s) - off).report(["pedal"])
        assert report["action_error"]["pedal"] == pytest.approx({"rmse": off, "max": off})


def test_a_speed_is_compared_with_its_set_point_at_the_same_moment():
    log = begun()
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
    none = {"rmse": None, "max": None}
    report = log_of(lambda time_s: 0.5).report(["pedal"])
    assert report["speed_error_mps"] == none
    assert (report["lag_ms"]["speed"], report["scale"]) == (None, None)
    nothing = TrackingLog().report(["pedal"])
    assert nothing["action_error"] == {"pedal": none}
    assert nothing["lag_ms"] == {"speed": None, "pedal": None}
    log = begun()
    for step in range(50):  # A vehicle that is asked nothing new shows no lag.
        log.command(make_command(step, action=[0.5], sent_ns=ns(step * T_S)))
        log.feedback(make_feedback(step, action=[0.5], sent_ns=ns(step * T_S + 0.02)))
    assert log.report(["pedal"])["lag_ms"]["pedal"] is None


def test_a_vehicle_that_brakes_by_itself_or_between_episodes_makes_no_error():
    log = log_of(held, episodes=1)
    log.feedback(make_feedback(0, action=[-1.0], sent_ns=ns(50.0), faults=["unheard"]))
    log.begin()
    log.command(make_command(0, action=[0.5], sent_ns=ns(60.0)))
    braking = {"self_braking": True, "faults": ["low battery"]}
    log.feedback(make_feedback(0, action=[-1.0], sent_ns=ns(60.1), **braking))
    report = log.report(["pedal"])
    assert report["action_error"]["pedal"]["max"] == 0.0
    assert report["faults"] == {"low battery": 1}
    for number in range(100):  # The words of faults are counted and bounded.
        log.feedback(make_feedback(0, faults=[f"fault {number}", "fault 0"]))
    faults = log.report([])["faults"]
    assert (len(faults), faults["fault 0"]) == (32, 101)
    log = begun()
    for step in range(20):  # Stamps of a clock that was stepped do no harm.
        stamp = ns(step * T_S if step < 10 else -50 + step * T_S)
        log.command(make_command(step, action=[asked_at(step)], sent_ns=stamp))
        log.feedback(make_feedback(step, action=[asked_at(step)], sent_ns=stamp + 1))
    assert log.report(["pedal"])["action_error"]["pedal"]["max"] == 0.0


DEAD_S = 0.03


class Rig:
    """A clock with a vehicle that reports the step it was sent last, ``dead_s`` after each."""

    def __init__(self, spec="none", dead_s=DEAD_S):
        self.dead_s, self.silent_from = dead_s, 99
        self.check = FeedbackCheck("here", action_size=1)
        commands = CommandCheck("here", action_size=1)
        self.clock = VehicleClock(self.publish, commands, parse_spec(spec), self.check)

    def publish(self, payload):
        step = decoded(payload).step
        self.clock.receive(encode(make_command(step)))
        if step >= self.silent_from:
            return
        if self.dead_s:
            threading.Timer(self.dead_s, self.report, [step]).start()
        else:
            self.report(step)

    def report(self, step, **changes):
        self.clock.receive_feedback(encode(make_feedback(step, sent_ns=step + 5, **changes)))

    def drive(self, steps):
        self.clock.begin(0, seed=0)
        return [self.clock.exchange(make_state(n, session="here")) for n in range(steps)]


@contextlib.contextmanager
def rig_of(spec="none", **options):
    rig = Rig(spec, **options)
    with contextlib.closing(rig.clock):
        yield rig


def test_each_tick_ends_with_what_the_vehicle_did_in_it():
    with rig_of() as rig:
        began_s = time.monotonic()
        decisions = rig.drive(4)
        assert time.monotonic() - began_s >= 4 * CONTROL_PERIOD_S
    assert [decision.feedback.step for decision in decisions] == [0, 1, 2, 3]
    assert [decision.brake_reason for decision in decisions] == [""] * 4
    assert all(0 < age_ms < 200 for age_ms in rig.clock.feedback_ages_ms)
    assert rig.check.rejected == {}


def test_a_vehicle_that_falls_silent_is_braked_for():
    # At once: on a busy machine a timer comes late, which would be silence, too.
    with rig_of(dead_s=0.0) as rig:
        rig.silent_from = 2
        decisions = rig.drive(6)
    assert [decision.brake_reason for decision in decisions[:2]] == ["", ""]
    assert (decisions[5].brake_reason, decisions[5].feedback) == (NO_FEEDBACK, None)


def test_an_injected_delay_holds_feedback_back_as_well():
    with rig_of("down.delay=150ms") as rig:
        decisions = rig.drive(5)
    known = [decision.feedback.step for decision in decisions if decision.feedback]
    assert 0 <= max(known) <= 3
    assert min(rig.clock.feedback_ages_ms) >= 150


def test_without_any_vehicle_it_says_what_to_do():
    with rig_of() as rig:
        with pytest.raises(UserError, match="no feedback from a vehicle of robot-1"):
            rig.clock.wait_for_vehicle(0.05, "robot-1")
        rig.report(-1, session="another", episode=-1)
        rig.clock.wait_for_vehicle(PATIENCE_S, "robot-1")


def test_an_episode_waits_until_the_vehicle_stands(monkeypatch):
    monkeypatch.setattr("bridge.clocks.STANDSTILL_WAIT_S", 0.3)
    with rig_of() as rig:
        rig.clock.begin(0, seed=0)
        rig.report(-1, speed_mps=1.0, session="", episode=-1)
        wait_until(lambda: rig.check.heard is not None, "the feedback")
        threading.Timer(0.1, rig.report, [0], {"speed_mps": 0.0, "session": ""}).start()
        rig.check.sent(0, 5)
        rig.clock.wait_for_standstill()
        assert rig.clock.moving_starts == 0
        rig.report(1, speed_mps=0.5)
        wait_until(lambda: rig.check.heard == make_feedback(1, speed_mps=0.5, sent_ns=6), "it")
        rig.clock.wait_for_standstill()
    assert rig.clock.moving_starts == 1


@contextlib.contextmanager
def stranger(endpoint):
    """Hears the vehicle's feedback, and sends it again, with more that nobody can believe.

    A call says whether the vehicle has got as far as a step of the first episode.
    """
    key, heard = "phil/hunter01/feedback", []

    def hear(sample):
        payload = sample.payload.to_bytes()
        feedback: Any = decode_feedback(payload)
        if not isinstance(feedback, Feedback) or feedback.vehicle != "mock" or payload in heard:
            return
        heard.append(payload)
        if feedback.session:
            other = make_feedback(0, session="stranger", sent_ns=feedback.sent_ns + 1)
            for bad in (payload, encode(other), b"\xff", heard[0]):
                session.put(key, bad)

    def is_at(step):
        feedback: Any = decode_feedback(heard[-1]) if heard else make_feedback(-1)
        return (feedback.episode, feedback.step) >= (0, step)

    with contextlib.closing(connect_client(endpoint, PATIENCE_S)) as session:
        subscriber = session.declare_subscriber(key, hear)
        yield is_at
        subscriber.undeclare()


def test_the_car_does_what_the_vehicle_did_whatever_a_stranger_says(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant", 0.3), free_endpoint()
    out = tmp_path / "report.json"
    options = ("--clock", "realtime", "--loop", "vehicle")
    with (
        start_simulate(endpoint, out, SHORT_TOY, *options) as run,
        start_edge(endpoint, policy, "--vehicle", "mock") as edge,
        stranger(endpoint) as is_at,
    ):
        wait_until(lambda: is_at(12), "the middle of the episode")
        edge.process.kill()
        assert run.wait() == 0, run.errors
    report = read(out)
    assert (report["loop"], report["clock"], report["standing"]) == ("vehicle", "realtime", True)
    vehicle = report["vehicle"]
    assert (vehicle["name"], vehicle["moving_starts"], vehicle["faults"]) == ("mock", 0, {})
    # Its actuators take their time: the pedal comes off the brake, and ends where it was asked.
    pedals = [action[0] for action in report["per_episode"][0]["actions"]]
    assert pedals[0] < 0.3
    assert pedals[10] == pytest.approx(0.3, abs=0.02)
    assert vehicle["action_error"]["pedal"]["max"] > 0.1
    # A vehicle that takes pedals has no speed set-point.
    assert vehicle["speed_error_mps"] == {"rmse": None, "max": None}
    rejected = report["rejected_by_simulator"]
    assert set(rejected) >= {f"feedback_{r}" for r in ("malformed", "foreign_session", "stale")}
    assert rejected["feedback_malformed"] >= 10
    # Nobody reports after a kill: the car brakes, and the report says why.
    last = report["safe_stop_events"][-1]
    assert (last["episode"], last["reason"]) == (0, NO_FEEDBACK)
    assert pedals[-1] == -1.0
