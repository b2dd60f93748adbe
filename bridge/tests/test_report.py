"""What is said of a drive: a line an episode, the last line, a vehicle's errors and its lag."""

import math
import shlex
from dataclasses import replace

import numpy as np
import pytest

from bridge import report as reports
from bridge.progress import ProgressBar
from edge_runtime.__main__ import main as edge_main
from edge_runtime.reach import free_endpoint
from hil_tests.testing.drives import SLOW_TOY, make_policy, start_simulate
from hil_tests.testing.edge import start_edge, wait_until_driving_steadily
from hil_tests.testing.messages import make_command, make_feedback

RESULT = reports.EpisodeResult(0, "goal", 21.0, 1.0, 12.3, 0.0, None, 123)
FACTS = {"scenario": "toy", "condition": "nominal", "policy_ids": ["p"], "seed": 0, "wall_s": 1.0}


def report_of(outcomes, stops=(), **rejected):
    results = [replace(RESULT, outcome=one, distance_m=10.0 * n) for n, one in enumerate(outcomes)]
    events = [reports.SafeStopEvent(0, 3, reason, 0.2) for reason in stops]
    return reports.make_report(results, events, [1.0], [1.0], FACTS | {"rejected": rejected})


def test_a_report_has_the_contracts_keys_and_lines_for_a_terminal():
    report = report_of(["collision", "goal"], ["no_command", "no_command"], stale=2)
    assert report["success_rate"] == report["collision_rate"] == 0.5
    assert report["surviving_distance_m"] == {"mean": 5.0, "std": 5.0}
    assert report["lateral_acceleration_mps2"] == {"mean": 0.0, "std": 0.0}
    assert report["longitudinal_acceleration_mps2"] == {"mean": None, "std": None}
    keys = ("episode_reward", "episode_time_s", "latency_ms", "rejected", "safe_stops")
    assert set(report) >= {"scenario", "condition", "episodes", "policy_id", "seed", *keys}
    line = reports.summary_line(report)
    for part in ("1 goal", "1 collision", "2 no_command", "2 stale", "p99 1.0 ms"):
        assert part in line
    stop = reports.SafeStopEvent(1, 3, "no\x1bcommand", 0.2)
    assert "no\\x1bcommand" in reports.episode_line(2, 5, RESULT, [stop])
    assert set(reports.quantiles([]).values()) == {None}


@pytest.mark.parametrize(
    ("outcomes", "success", "settled"),
    [
        (["truncated", "goal", "truncated"], 1 / 3, ["timeout", "goal", "timeout"]),
        (["failed", "truncated", "ended"], 0.0, ["failed", "timeout", "ended"]),
        (["truncated", "stopped"], None, ["truncated", "stopped"]),
    ],
)
def test_a_limit_of_steps_is_a_timeout_where_another_episode_tells(outcomes, success, settled):
    report = report_of(outcomes)
    assert [row["outcome"] for row in report["per_episode"]] == settled
    assert report["success_rate"] == success


def test_no_progress_tells_of_less_than_nothing_to_come(capsys):
    with ProgressBar("training", 10) as bar:
        bar.advance({"return": "3.0"}, 14)  # An episode is driven to its end.
    assert capsys.readouterr().err == "training: 14/10  return 3.0\n"


def test_a_car_that_waits_for_its_rearm_says_so_at_both_ends_with_the_command(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant"), free_endpoint()
    config = tmp_path / "edge.toml"
    config.write_text("armed_at_start = false\n")
    rearm = f"python -m edge_runtime rearm --connect {endpoint} --vehicle-id hunter01"
    with (
        start_edge(endpoint, policy, "--vehicle", "mock", "--config", str(config)) as edge,
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY, "--clock", "realtime") as run,
    ):
        run.wait_for_line("the vehicle stands")
        assert run.errors == f"the vehicle stands until it is re-armed: {rearm}\n"
        assert f"waits_for_rearm command='{rearm}'" in edge.errors
        assert edge_main(shlex.split(rearm)[3:]) == 0
        wait_until_driving_steadily(edge)
        assert edge.errors.count("waits_for_rearm") == 1


T_S, REPORT_S, STEPS = 0.1, 0.05, 120


def asked_at(time_s):
    step = min(int(time_s / T_S), STEPS - 1)
    asked = 0.7 * math.sin(0.31 * step) + 0.5 * math.sin(0.113 * step)
    return float(np.clip(asked, -1, 1)) if time_s >= 0 else -1.0


def ns(time_s):
    return round((5.0 + time_s) * 1e9)


def log_of(reached, zeros_s=(0.0, 100.0), asked=asked_at):
    """The log of a vehicle that has reached ``reached(t)`` at t, in each of the episodes."""
    log = reports.TrackingLog()
    for zero_s in zeros_s:
        log.begin()
        for step in range(STEPS):
            action = [asked((step + 0.5) * T_S)]
            log.command(make_command(step, action=action, sent_ns=ns(zero_s + step * T_S)))
        for time_s in np.arange(0.013, STEPS * T_S, REPORT_S):
            stamp = ns(zero_s + time_s)
            log.feedback(make_feedback(0, action=[reached(time_s)], sent_ns=stamp))
        log.end()
    return log


def follower(dead_s, constant_s):
    """What a first-order actuator behind a dead time has reached at each time."""
    step_s, values = 0.001, [-1.0]
    for index in range(int(STEPS * T_S / step_s) + 100):
        share = 1 - math.exp(-step_s / constant_s)
        values.append(values[-1] + (asked_at(index * step_s - dead_s) - values[-1]) * share)
    return lambda time_s: values[round(time_s / step_s) + 1]


@pytest.mark.parametrize("delay_s", [0.0, 0.06, 0.4])
def test_a_delay_is_found(delay_s):
    report = log_of(lambda time_s: asked_at(time_s - delay_s)).report(["pedal"])
    assert (report["action_error"]["pedal"]["max"] > 0.0) == (delay_s > 0.0)
    # Asked and reached are steps here: all delays between two reports are as good.
    assert report["lag_ms"]["pedal"] == pytest.approx(delay_s * 1e3, abs=REPORT_S / 2 * 1e3)


@pytest.mark.parametrize(("dead_s", "constant_s"), [(0.02, 0.05), (0.2, 0.3)])
def test_a_lag_lies_between_the_dead_time_and_its_sum_with_the_time_constant(dead_s, constant_s):
    lag_s = log_of(follower(dead_s, constant_s)).report(["pedal"])["lag_ms"]["pedal"] / 1e3
    half_s = REPORT_S / 2
    assert dead_s + 0.5 * constant_s - half_s < lag_s < dead_s + constant_s + half_s


def test_a_speed_is_compared_with_its_set_point_at_the_same_moment():
    log = reports.TrackingLog()
    log.begin()
    for time_s in np.arange(0, 10, REPORT_S):
        asked, reached = (1 + math.sin(2 * (time_s - lag_s)) for lag_s in (0.0, 0.2))
        speeds = {"speed_mps": reached, "commanded_speed_mps": asked}
        log.feedback(make_feedback(0, sent_ns=ns(time_s), scenario_speed_mps=4.0, **speeds))
    report = log.report([])
    assert report["lag_ms"] == {"speed": pytest.approx(200, abs=1e3 * reports.LAG_STEP_S)}
    assert report["speed_error_mps"]["max"] == pytest.approx(2 * math.sin(0.2), abs=0.01)


def test_what_was_not_measured_is_none():
    for log in (reports.TrackingLog(), log_of(lambda _: 0.5, asked=lambda _: 0.5)):
        report = log.report(["pedal"])
        assert report["lag_ms"] == {"speed": None, "pedal": None}
        assert report["speed_error_mps"] == {"rmse": None, "max": None}
    assert reports.TrackingLog().report(["pedal"])["action_error"]["pedal"]["rmse"] is None


def test_a_vehicle_that_brakes_by_itself_or_between_episodes_makes_no_error():
    log = log_of(asked_at, [0.0])
    log.feedback(make_feedback(0, action=[-1.0], sent_ns=ns(50.0), faults=["unheard"]))
    log.begin()
    log.command(make_command(0, action=[0.5], sent_ns=ns(60.0)))
    for number in range(100):  # The words of faults are counted and bounded.
        faults = {"self_braking": True, "faults": [f"fault {number}", "fault 0"]}
        log.feedback(make_feedback(0, action=[-1.0], sent_ns=ns(60.1), **faults))
    report = log.report(["pedal"])
    assert report["action_error"]["pedal"]["max"] == 0.0
    assert (len(report["faults"]), report["faults"]["fault 0"]) == (32, 101)
    log = reports.TrackingLog()
    log.begin()
    for step in range(20):  # Stamps of a clock that was stepped do no harm.
        stamp, action = ns(step * T_S - 50 * (step >= 10)), [asked_at(step * T_S)]
        log.command(make_command(step, action=action, sent_ns=stamp))
        log.feedback(make_feedback(step, action=action, sent_ns=stamp + 1))
    assert log.report(["pedal"])["action_error"]["pedal"]["max"] == 0.0
