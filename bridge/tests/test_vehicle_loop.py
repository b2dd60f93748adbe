"""``--loop vehicle``: the clock without a network, and real processes with the mock vehicle."""

from __future__ import annotations

import contextlib
import threading
import time

import pytest

from bridge.command_check import CommandCheck
from bridge.feed import connect_client
from bridge.feedback_check import FeedbackCheck
from bridge.feedback_hold import NO_FEEDBACK
from bridge.tests.commands import make_command, make_feedback
from bridge.tests.processes import (
    SHORT_TOY,
    bridge_status,
    make_policy,
    read,
    start_edge,
    start_simulate,
)
from bridge.vehicle_clock import VehicleClock
from edge_runtime.latency.model import parse_spec
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import PATIENCE_S, make_state, wait_until
from edge_runtime.util import UserError
from edge_runtime.wire import (
    CONTROL_PERIOD_S,
    Feedback,
    State,
    decode_feedback,
    decode_state,
    encode,
)

DEAD_S = 0.03


class Rig:
    """A clock with a vehicle that reports the step it was sent last, ``dead_s`` after each."""

    def __init__(self, spec="none", dead_s=DEAD_S):
        self.dead_s = dead_s
        self.check = FeedbackCheck("here", action_size=1)
        commands = CommandCheck("here", action_size=1)
        self.clock = VehicleClock(self.publish, commands, parse_spec(spec), self.check)
        self.silent_from = 99

    def publish(self, payload):
        state = decode_state(payload)
        assert isinstance(state, State)
        self.clock.receive(encode(make_command(state.step)))
        if state.step >= self.silent_from:
            return
        if self.dead_s:
            threading.Timer(self.dead_s, self.report, [state.step]).start()
        else:
            self.report(state.step)

    def report(self, step, **changes):
        self.clock.receive_feedback(encode(make_feedback(step, sent_ns=step + 5, **changes)))


@contextlib.contextmanager
def rig_of(spec="none", **options):
    rig = Rig(spec, **options)
    try:
        yield rig
    finally:
        rig.clock.close()


def test_each_tick_ends_with_what_the_vehicle_did_in_it():
    with rig_of() as rig:
        began_s = time.monotonic()
        rig.clock.begin(0, seed=0)
        decisions = [rig.clock.exchange(make_state(n, session="here")) for n in range(4)]
        assert time.monotonic() - began_s >= 4 * CONTROL_PERIOD_S
    assert [decision.feedback.step for decision in decisions] == [0, 1, 2, 3]
    assert [decision.brake_reason for decision in decisions] == [""] * 4
    assert all(0 < age_ms < 200 for age_ms in rig.clock.feedback_ages_ms)
    assert rig.check.rejected == {}


def test_a_vehicle_that_falls_silent_is_braked_for():
    # At once: on a busy machine a timer comes late, which would be silence, too.
    with rig_of(dead_s=0.0) as rig:
        rig.silent_from = 2
        rig.clock.begin(0, seed=0)
        decisions = [rig.clock.exchange(make_state(n, session="here")) for n in range(6)]
    assert [decision.brake_reason for decision in decisions[:2]] == ["", ""]
    assert decisions[5].brake_reason == NO_FEEDBACK
    assert decisions[5].feedback is None


def test_an_injected_delay_holds_feedback_back_as_well():
    with rig_of("down.delay=150ms") as rig:
        rig.clock.begin(0, seed=0)
        decisions = [rig.clock.exchange(make_state(n, session="here")) for n in range(5)]
    known = [decision.feedback.step for decision in decisions if decision.feedback]
    assert known
    assert max(known) <= 3
    assert min(rig.clock.feedback_ages_ms) >= 150


def test_without_any_vehicle_it_says_what_to_do():
    with rig_of() as rig:
        with pytest.raises(UserError, match="no feedback from a vehicle of robot-1"):
            rig.clock.wait_for_vehicle(0.05, "robot-1")
        rig.report(-1, session="another", episode=-1)
        rig.clock.wait_for_vehicle(PATIENCE_S, "robot-1")


def test_an_episode_waits_until_the_vehicle_stands(monkeypatch):
    monkeypatch.setattr("bridge.vehicle_clock.STANDSTILL_WAIT_S", 0.3)
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


def test_lock_step_cannot_have_a_vehicle(capsys):
    assert bridge_status(["simulate", "--env", SHORT_TOY, "--loop", "vehicle"]) == 2
    assert "--loop vehicle needs --clock realtime" in capsys.readouterr().err


class Stranger:
    """Hears the vehicle's feedback, and sends it again, with more that nobody can believe."""

    def __init__(self, endpoint):
        self.heard = []
        self._key = "phil/hunter01/feedback"
        self._session = connect_client(endpoint, PATIENCE_S)
        self._subscriber = self._session.declare_subscriber(self._key, self._hear)

    def _hear(self, sample):
        payload = sample.payload.to_bytes()
        feedback = decode_feedback(payload)
        if not isinstance(feedback, Feedback) or feedback.vehicle != "mock":
            return
        if payload in self.heard:
            return
        self.heard.append(payload)
        if feedback.session:
            other = make_feedback(0, session="stranger", sent_ns=feedback.sent_ns + 1)
            for bad in (payload, encode(other), b"\xff", self.heard[0]):
                self._session.put(self._key, bad)

    def is_at(self, episode, step):
        feedback = decode_feedback(self.heard[-1]) if self.heard else None
        return isinstance(feedback, Feedback) and (feedback.episode, feedback.step) >= (
            episode,
            step,
        )

    def close(self):
        self._subscriber.undeclare()
        self._session.close()


def test_the_car_does_what_the_vehicle_did_whatever_a_stranger_says(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant", 0.3), free_endpoint()
    out = tmp_path / "report.json"
    options = ("--clock", "realtime", "--loop", "vehicle")
    with (
        start_simulate(endpoint, out, SHORT_TOY, *options) as run,
        start_edge(endpoint, policy, "--vehicle", "mock") as edge,
        contextlib.closing(Stranger(endpoint)) as stranger,
    ):
        wait_until(lambda: stranger.is_at(0, 12), "the middle of the episode")
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
