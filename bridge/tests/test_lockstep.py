"""Virtual time without a network: the edge runtime is a function that answers at once."""

from __future__ import annotations

import time

from bridge.command_check import CommandCheck
from bridge.lockstep import LockStepClock
from bridge.tests.commands import make_command
from edge_runtime.latency.command_hold import NO_COMMAND
from edge_runtime.latency.model import parse_spec
from edge_runtime.tests.harness import make_state
from edge_runtime.wire import State, decode_state, encode


def obedient(step):
    return make_command(step, action=[step / 1000])


class Rig:
    """A clock whose publications are answered in the same call; ``answer`` None is a dead edge."""

    def __init__(self, spec="none", answer=obedient):
        self.check = CommandCheck("here", action_size=1)
        self.clock = LockStepClock(self.publish, self.check, parse_spec(spec))
        self.published: list[int] = []
        self.answer = answer

    def publish(self, payload):
        state = decode_state(payload)
        assert isinstance(state, State)
        # The edge runtime answers no state that is older than one it has seen.
        overtaken = any(state.step < step for step in self.published)
        self.published.append(state.step)
        if not overtaken and self.answer is not None:
            self.clock.receive(encode(self.answer(state.step)))

    def drive(self, steps, seed=0):
        self.clock.begin(0, seed)
        return [self.clock.exchange(make_state(step, session="here")) for step in range(steps)]


def used(decisions):
    return [None if d.command is None else d.command.step for d in decisions]


def test_without_latency_every_state_meets_its_own_command():
    rig = Rig()
    assert used(rig.drive(10)) == list(range(10))
    assert not rig.check.rejected


def test_a_command_inside_the_window_acts_in_its_tick_and_outside_it_in_the_next():
    assert used(Rig("up.delay=10ms,down.delay=15ms").drive(4)) == [0, 1, 2, 3]
    assert used(Rig("up.delay=10ms,down.delay=15.1ms").drive(4)) == [None, 0, 1, 2]


def test_the_action_is_as_old_as_the_latency():
    decisions = Rig("100ms").drive(6)
    assert used(decisions) == [None, None, 0, 1, 2, 3]
    assert not any(decision.brake_reason for decision in decisions)


def test_the_latency_reported_is_the_virtual_one():
    rig = Rig("50ms")
    rig.drive(10)
    assert all(100 <= latency_ms < 150 for latency_ms in rig.clock.latencies_ms)
    assert len(rig.clock.latencies_ms) == 9


def test_the_same_seed_is_the_same_run_and_another_seed_another():
    spec = "60ms+-40ms,loss=10%"
    first, again, other = (used(Rig(spec).drive(60, seed)) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_jitter_reorders_and_the_overtaken_state_is_not_waited_for():
    rig = Rig("up.delay=100ms,up.jitter=80ms")
    started_s = time.monotonic()
    rig.drive(60)
    assert rig.published != sorted(rig.published)
    assert time.monotonic() - started_s < 2.0  # Nothing timed out.


def test_a_dead_link_brakes_after_2_periods_of_virtual_time():
    for spec in ("up.loss=100%", "down.loss=100%"):
        rig = Rig(spec)
        reasons = [decision.brake_reason for decision in rig.drive(6)]
        assert reasons == ["", "", NO_COMMAND, NO_COMMAND, NO_COMMAND, NO_COMMAND]


def test_a_silent_edge_costs_2_periods_of_wall_time_once_then_one_a_step():
    rig = Rig()
    rig.drive(3)
    rig.answer = None
    started_s = time.monotonic()
    decisions = [rig.clock.exchange(make_state(step, session="here")) for step in (3, 4)]
    waited_s = time.monotonic() - started_s
    assert [decision.brake_reason for decision in decisions] == [NO_COMMAND, NO_COMMAND]
    assert decisions[0].undriven_s >= 0.2
    assert 0.28 <= waited_s < 1.0
    rig.answer = obedient
    assert rig.clock.exchange(make_state(5, session="here")).brake_reason == ""


def test_a_safe_stop_command_brakes_with_its_reason():
    stop = make_command(0, mode="safe_stop", reason="inference_too_slow")
    assert Rig(answer=lambda step: stop).drive(1)[0].brake_reason == "inference_too_slow"


def test_only_faults_are_counted_among_what_comes_unasked():
    rig = Rig()
    rig.drive(3)
    rig.clock.receive(encode(make_command(2, mode="safe_stop")))  # The edge's own watchdog.
    rig.clock.receive(encode(make_command(2, session="elsewhere")))
    rig.clock.receive(b"junk")
    rig.clock.exchange(make_state(3, session="here"))
    assert dict(rig.check.rejected) == {"foreign_session": 1, "malformed": 1}
