"""The clocks: in lock-step, in real time, and with a vehicle in the loop."""

import contextlib
import threading
import time
from functools import partial
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from bridge.clocks import DelayLine, LockStepClock, RealTimeClock, VehicleClock
from bridge.inbound import NO_COMMAND, NO_FEEDBACK, CommandCheck
from bridge.network import parse_spec
from bridge.report import SafeStopLog
from bridge.tests.recordings import wait_until_driving_steadily
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.wire import encode
from hil_tests.processes import PATIENCE_S, wait_until
from hil_tests.tests.shared.drives import SLOW_TOY, make_policy, read, start_edge, start_simulate
from hil_tests.tests.shared.messages import make_command, make_feedback, make_state
from hil_tests.tests.shared.policies import TASK, T


def test_what_an_action_raises_reaches_the_caller():
    line, fail = DelayLine(), Mock(side_effect=ValueError("no link"))
    line.push(time.monotonic(), fail)
    wait_until(lambda: not line._thread.is_alive(), "the line to end")
    for again in (lambda: line.push(time.monotonic(), fail), line.close):
        with pytest.raises(ValueError, match="no link"):
            again()


def test_a_line_runs_what_is_due_in_order_of_time_then_of_arrival_and_forgets_the_rest():
    ran: list[int] = []
    with contextlib.closing(DelayLine()) as line:
        line.push(time.monotonic() + 0.6, lambda: ran.append(-1))
        line.clear()
        due_s = time.monotonic() + 0.2
        for number, at_s in [(50, due_s + 0.6), *((k, due_s) for k in range(50))]:
            line.push(at_s, partial(ran.append, number))
        wait_until(lambda: len(ran) == 51, "all but what was forgotten")
    assert ran == list(range(51))


def obedient(step):
    return make_command(step, action=[step / 1000])


def stopping(step):
    return make_command(step, mode="safe_stop", reason="vehicle_fault")


class Rig:
    """A clock whose publications are answered in the same call; ``answer`` None is a dead edge."""

    def __init__(self, spec="none", answer=obedient, kind=LockStepClock):
        self.check: Any = CommandCheck("here", TASK)
        self.clock = kind(self.publish, self.check, parse_spec(spec))
        self.published: list[int] = []
        self.answer = answer

    def publish(self, payload):
        step = msgspec.msgpack.decode(payload)["step"]
        # The edge runtime answers no state that is as old as one it has seen, or older.
        refused = any(step <= before for before in self.published)
        self.published.append(step)
        if not refused and self.answer is not None:
            self.clock.receive(encode(self.answer(step)))

    def exchange(self, *steps):
        return [self.clock.exchange(make_state(step, session="here")) for step in steps]

    def drive(self, steps, seed=0):
        self.clock.begin(0, seed)
        return self.exchange(*range(steps))


def used(decisions):
    return [None if d.command is None else d.command.step for d in decisions]


def reasons(decisions):
    return [decision.brake_reason for decision in decisions]


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("none", [0, 1, 2, 3, 4, 5]),
        # A command inside the window acts in its tick, and outside it in the next.
        ("up.delay=10ms,down.delay=15ms", [0, 1, 2, 3, 4, 5]),
        ("up.delay=10ms,down.delay=15.1ms", [None, 0, 1, 2, 3, 4]),
        ("50ms", [None, 0, 1, 2, 3, 4]),
        ("100ms", [None, None, 0, 1, 2, 3]),
    ],
)
def test_a_command_acts_as_late_as_the_latency_says(spec, expected):
    rig = Rig(spec)
    decisions = rig.drive(6)
    assert used(decisions) == expected
    assert not any(reasons(decisions))
    assert not rig.check.rejected
    if spec == "50ms":  # The latency that is reported is the virtual one.
        assert all(100 <= latency_ms < 150 for latency_ms in rig.clock.latencies_ms)
        assert len(rig.clock.latencies_ms) == 5


def test_overtaken_and_repeated_states_reach_the_edge_and_are_not_waited_for():
    late, twice = Rig("up.delay=100ms,up.jitter=80ms"), Rig("10ms,duplicate=100%")
    late.drive(60)
    assert late.published != sorted(late.published)
    decisions = twice.drive(20)
    assert late.clock.wall_clock_stalls == twice.clock.wall_clock_stalls == 0  # None timed out.
    assert twice.published == [step for step in range(20) for _ in range(2)]
    assert used(decisions) == list(range(20))
    assert dict(twice.check.rejected) == {"stale": 20}
    assert len(twice.clock.latencies_ms) == 20


def test_an_outage_brakes_and_ends_with_the_fifth_fresh_state():
    found = reasons(Rig("outage=0.5s@1s").drive(20))
    assert [bool(reason) for reason in found] == [11 <= step < 19 for step in range(20)]
    assert set(found[11:15]) == {NO_COMMAND}
    assert set(found[15:19]) == {"no_fresh_state"}
    one, two = (reasons(Rig(f"up.outage={length}s@0.95s").drive(20)) for length in (0.1, 0.2))
    assert not any(one)  # One lost state is no silence.
    assert [reason for reason in two if reason] == [NO_COMMAND, *["no_fresh_state"] * 4]


def planned(step):
    return make_command(step, action=[0.5], plan=[[k / 10] for k in range(1, 6)])


def test_a_plan_carries_it_over_an_outage_of_its_length_and_not_of_more():
    rig = Rig("outage=0.5s@1s", planned)
    found = rig.drive(20)
    assert not any(reasons(found))
    assert [decision.ridden for decision in found[9:16]] == [0, 1, 2, 3, 4, 5, 0]
    assert [one.command.action for one in found[9:12]] == [[0.5], [0.1], [0.2]]
    # Up to 0.7 s after the last command it rides, on the last of its actions; then it recovers.
    found = Rig("outage=0.8s@1s", planned).drive(26)
    assert [one.ridden for one in found[10:17]] == [1, 2, 3, 4, 5, 5, 0]
    assert [bool(reason) for reason in reasons(found)] == [16 <= step < 22 for step in range(26)]
    # The edge runtime's own rule, when only states are lost.
    found = reasons(Rig("up.outage=0.7s@1s", planned).drive(20))
    assert {reason for reason in found if reason} == {NO_COMMAND, "no_fresh_state"}
    assert not any(reasons(Rig("up.outage=0.6s@1s", planned).drive(20)))


def test_a_machine_that_stalls_is_counted_apart_from_the_network():
    rig, late = Rig(), Rig("outage=0.5s@1s")
    rig.drive(3)
    rig.answer = lambda step: make_command(step, mode="safe_stop", reason="no_fresh_state")
    assert reasons(rig.exchange(3)) == ["no_fresh_state"]
    late.drive(20)
    assert (rig.clock.wall_clock_stalls, late.clock.wall_clock_stalls) == (1, 0)


@pytest.mark.parametrize("kind", [LockStepClock, RealTimeClock])
@pytest.mark.parametrize(
    ("spec", "answer", "first_step", "stops"),
    [
        ("150ms", obedient, 0, []),
        ("150ms", stopping, 0, ["vehicle_fault"]),
        ("down.loss=100%", obedient, None, [NO_COMMAND]),
        ("up.outage=0.45s@0s", obedient, 5, [NO_COMMAND]),
    ],
)
def test_the_wait_for_the_first_answer_brakes_and_is_no_stop(kind, spec, answer, first_step, stops):
    rig = Rig(spec, answer, kind)
    with contextlib.closing(rig.clock):
        found = rig.drive(8)
    assert NO_COMMAND in reasons(found), "it does not drive on without a command"
    assert next((step for step in used(found) if step is not None), None) == first_step
    assert stops_of(found) == stops


def stops_of(decisions):
    log = SafeStopLog()
    for step, decision in enumerate(decisions):
        log.observe(0, step, decision)
    return [event.reason for event in log.events]


def test_a_silent_edge_costs_2_periods_of_wall_time_once_then_one_a_step():
    rig = Rig()
    rig.drive(3)
    rig.answer = None
    started_s = time.monotonic()
    decisions = rig.exchange(3, 4)
    assert 0.28 <= time.monotonic() - started_s < 1.0
    assert reasons(decisions) == [NO_COMMAND, NO_COMMAND]
    rig.answer = obedient
    assert reasons(rig.exchange(5)) == [""]


def test_only_faults_are_counted_among_what_comes_unasked():
    rig = Rig()
    rig.drive(3)
    watchdog, foreign = make_command(2, mode="safe_stop"), make_command(2, session="elsewhere")
    for payload in (encode(watchdog), encode(foreign), b"junk"):
        rig.clock.receive(payload)
    rig.exchange(3)
    assert dict(rig.check.rejected) == {"foreign_session": 1, "malformed": 1}


@pytest.mark.parametrize("spec", ["5ms,duplicate=100%", "up.outage=1000s@0.25s"])
def test_in_real_time_all_is_delayed_duplicated_and_lost_from_the_episodes_start(spec):
    rig = Rig(spec, make_command, RealTimeClock)
    with contextlib.closing(rig.clock):
        rig.drive(7)
    if "outage" in spec:
        assert rig.published[0] == 0
        assert 6 not in rig.published
    else:  # The last command's copy may come after the last tick.
        assert rig.published == [step for step in range(7) for _ in range(2)]
        assert 6 <= rig.check.rejected["stale"] <= 7
        assert len(rig.clock.latencies_ms) == 7
        assert min(rig.clock.latencies_ms) >= 10.0


def test_in_real_time_a_stall_is_counted_and_not_caught_up():
    rig = Rig(answer=make_command, kind=RealTimeClock)
    with contextlib.closing(rig.clock):
        rig.drive(1)
        time.sleep(3.5 * T)
        rig.exchange(1)
        began_s = time.monotonic()
        rig.exchange(2)
    assert rig.clock.missed_ticks >= 2
    assert time.monotonic() - began_s > 0.7 * T


class VehicleRig(Rig):
    """A clock with a vehicle that reports the step it was sent last, 30 ms after each."""

    def __init__(self, spec="none"):
        self.clock = VehicleClock(self.publish, CommandCheck("here", TASK), parse_spec(spec))
        self.check = self.clock.feedback_check
        self.close = self.clock.close

    def publish(self, payload):
        step = msgspec.msgpack.decode(payload)["step"]
        self.clock.receive(encode(make_command(step)))
        threading.Timer(0.03, self.report, [step]).start()

    def report(self, step, **changes):
        self.clock.receive_feedback(encode(make_feedback(step, sent_ns=step + 5, **changes)))


def test_each_tick_ends_with_what_the_vehicle_did_in_it():
    with contextlib.closing(VehicleRig()) as rig:
        began_s = time.monotonic()
        decisions = rig.drive(4)
        assert time.monotonic() - began_s >= 4 * T
        assert rig.clock.rejected() == {}
        for bad in (b"\xff", encode(make_feedback(0, session="stranger"))):
            rig.clock.receive_feedback(bad)
        wait_until(lambda: rig.clock.rejected().total() == 2, "both to be counted")
    assert rig.clock.rejected() == {"feedback_malformed": 1, "feedback_foreign_session": 1}
    assert [decision.feedback.step for decision in decisions] == [0, 1, 2, 3]
    assert reasons(decisions) == [""] * 4


def test_an_episode_waits_until_there_is_a_vehicle_and_it_stands(monkeypatch):
    monkeypatch.setattr("bridge.clocks.STANDSTILL_WAIT_S", 0.3)
    with contextlib.closing(VehicleRig()) as rig:
        with pytest.raises(UserError):
            rig.clock.wait_for_vehicle(0.05, "start")
        rig.report(-1, speed_mps=1.0, session="another", episode=-1)
        rig.clock.wait_for_vehicle(PATIENCE_S, "start")
        rig.clock.begin(0, seed=0)
        threading.Timer(0.1, rig.report, [0], {"speed_mps": 0.0, "session": ""}).start()
        rig.clock.check.sent(5)
        rig.clock.wait_for_standstill()
        assert rig.check.heard.speed_mps == 0.0
        rig.report(1, speed_mps=0.5)
        wait_until(lambda: rig.check.heard == make_feedback(1, speed_mps=0.5, sent_ns=6), "it")
        began_s = time.monotonic()
        rig.clock.wait_for_standstill()
        assert time.monotonic() - began_s >= 0.3


def test_the_car_does_what_the_vehicle_did(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant", 0.3), free_endpoint()
    out = tmp_path / "report.json"
    options = ("--clock", "realtime", "--loop", "vehicle")
    with (
        start_simulate(endpoint, out, SLOW_TOY, *options) as run,
        start_edge(endpoint, policy, "--vehicle", "mock") as edge,
    ):
        wait_until_driving_steadily(edge, 2.0)
        edge.kill()
        assert run.wait() == 0, run.errors
    report = read(out)
    assert (report["loop"], report["clock"], report["standing"]) == ("vehicle", "realtime", True)
    assert report["vehicle"] == {"name": "mock", "faults": {}}
    # Its actuators take their time: the pedal comes off the brake, and ends where it was asked.
    pedals = [action[0] for action in report["per_episode"][0]["actions"]]
    assert pedals[0] < 0.3
    assert pedals[10] == pytest.approx(0.3, abs=0.02)
    # Nobody reports after a kill: the car brakes, and the report says why.
    last = report["safe_stop_events"][-1]
    assert (last["episode"], last["reason"]) == (0, NO_FEEDBACK)
    assert pedals[-1] == -1.0
