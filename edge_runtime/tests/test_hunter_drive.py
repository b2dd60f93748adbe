"""The Hunter's driver in made-up time: commands, its own stops, and its end."""

from __future__ import annotations

import pytest

from edge_runtime.tests.hunter_bench import (
    OK,
    STREAM_S,
    Bench,
    sent_ids,
    told_by,
)
from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.states import State


def test_pedals_become_a_speed_and_the_speed_comes_back_as_the_scenarios():
    bench = Bench().driving(1.0)
    report = bench.core.report(bench.now_s)
    assert report.speed_mps == pytest.approx(46 * 0.75 * STREAM_S)  # its first command came late
    assert report.scenario_speed_mps == pytest.approx(4 * report.speed_mps)
    assert report.commanded_speed_mps == pytest.approx(report.speed_mps, abs=0.002)
    assert report.action["pedal"] == pytest.approx(1.0, abs=0.05)
    assert (report.faults, report.self_braking, report.battery_v) == ([], False, 24.0)
    bench.step(20, {"pedal": -0.5})
    assert bench.core.report(bench.now_s).action["pedal"] == pytest.approx(-0.5, abs=0.05)


def test_a_policy_without_a_pedal_has_the_scenarios_speed():
    bench = Bench("congestion").enabled()
    bench.step(200, {"steering": -1.0}, scenario_speed_mps=4.0)
    assert bench.speed_mps == pytest.approx(1.0)
    assert bench.inner_rad > 0.05
    assert bench.core.report(bench.now_s).action["steering"] == pytest.approx(-1.0, abs=0.02)
    bench.step(100, {"steering": 1.0}, scenario_speed_mps=0.0)
    assert bench.speed_mps == 0.0
    assert bench.inner_rad < -0.05


def test_a_brake_is_speed_zero_at_once_and_latches():
    bench = Bench().driving()
    bench.core.brake(bench.now_s)
    assert bench.core.report(bench.now_s).commanded_speed_mps == 0.0  # before the next tick, too
    count = len(bench.sent)
    bench.step(100, {"pedal": 1.0})
    assert set(bench.motions(count)) == {(0.0, 0.0)}
    assert bench.words == []  # our own wish is no fault
    assert bench.core.report(bench.now_s).self_braking
    bench.enabled().step(20, {"pedal": 1.0})
    assert bench.speed_mps > 0


def test_the_stop_at_an_episodes_end_needs_no_repetition_and_does_not_latch():
    bench = Bench().driving()
    bench.core.brake(bench.now_s, latch=False)
    count = len(bench.sent)
    bench.step(500)
    assert set(bench.motions(count)) == {(0.0, 0.0)}
    assert bench.core.state is State.ENABLED
    bench.step(20, {"pedal": 1.0})
    assert bench.speed_mps > 0


def test_without_a_fresh_command_it_stops_within_the_promise_and_latches():
    bench = Bench().driving()
    last_s = bench.core._wished_s
    assert bench.core.late_at_s == last_s + 0.24 < last_s + 0.25  # vehicle.py ticks then, too
    count = len(bench.sent)
    bench.step(100)
    assert bench.core.late_at_s == float("inf")
    stopped_s = next(
        time_s
        for time_s, part in bench.sent[count:]
        if part.frame.can_id == 0x111 and told_by(part).speed_mps == 0
    )
    assert 0.2 < stopped_s - last_s <= 0.25 + 0.02
    assert bench.words == ["no command for 0.24 s"]
    bench.step(50, {"pedal": 1.0})
    assert bench.speed_mps == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_command_that_is_not_finite_is_refused(value):
    bench = Bench().enabled()
    for action, speed in (({"pedal": value}, None), ({"steering": value}, 1.0), ({}, value)):
        with pytest.raises(ValueError, match="not finite"):
            bench.core.command(action, bench.now_s, speed)
    bench.step(10)
    assert bench.speed_mps == 0


@pytest.mark.parametrize(
    ("action", "speed_mps"), [({}, 6.0), ({}, None), ({"steering": 0.1}, None)]
)
def test_a_command_that_lacks_an_action_is_refused(action, speed_mps):
    """No pedal means the speed of the scenario's car only where there is a steering beside it."""
    bench = Bench().enabled()
    with pytest.raises(ValueError, match="lacks an action"):
        bench.core.command(action, bench.now_s, speed_mps)
    bench.step(10)
    assert bench.speed_mps == 0


def test_the_remote_control_keeps_its_brake_and_its_control_at_the_end():
    bench = Bench().driving()
    bench.status = OK._replace(mode=frames.REMOTE_CONTROL)
    bench.obeys, bench.speed_mps = False, 1.0  # a person drives
    count = len(bench.sent)
    bench.step(200, {"pedal": 1.0})
    assert set(sent_ids(bench)[count + 6 :]) == {0x111}
    ends = [part.frame.can_id for part in bench.core.close(bench.now_s)]
    assert ends == [0x111, 0x421]


@pytest.mark.parametrize("brakes", [True, False])
def test_the_end_stands_parks_and_gives_control_back(brakes):
    bench = Bench().driving()
    if brakes:
        bench.core.brake(bench.now_s)
    ends = bench.core.close(bench.now_s)
    assert [(part.frame.can_id, part.data) for part in ends] == [
        (0x111, bytes(8)),
        (0x131, b"\x01"),
        (0x421, b"\x00"),
    ]
    assert bench.core.tick(bench.now_s) == []


# The rules that the table was written from, in other words.
