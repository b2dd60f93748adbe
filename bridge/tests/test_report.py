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

RESULT = reports.EpisodeResult(0, "goal", 21.0, 1.0, 12.3, 0.0, 0.0, 123)


def report_of(outcomes, stops=(), rejected=None):
    return reports.make_report(
        [replace(RESULT, outcome=outcome) for outcome in outcomes],
        [reports.SafeStopEvent(0, 3, reason, 0.2) for reason in stops],
        latencies_ms=[1.0],
        command_ages_ms=[1.0],
        facts={
            "scenario": "toy", "condition": "nominal", "policy_ids": ["p"], "seed": 0,
            "deadline_misses": 38, "rejected": rejected or {}, "wall_s": 1.0,
        },
    )  # fmt: skip


def test_lines_for_a_terminal_name_outcomes_and_reasons_and_are_printable():
    report = report_of(["goal", "timeout"], ["no_command", "no_command"], {"stale": 2})
    line = reports.summary_line(report)
    for part in ("1 goal (50%)", "1 timeout (50%)", "2 no_command", "2 stale", "p99 1.0 ms"):
        assert part in line
    stop = reports.SafeStopEvent(1, 3, "no\x1bcommand", 0.2)
    assert "no\\x1bcommand" in reports.episode_line(2, 5, RESULT, [stop])


def test_summarise_by_hand():
    ends = {"goal": 10.0, "collision": 20.0}.items()
    results = [replace(RESULT, outcome=outcome, distance_m=way_m) for outcome, way_m in ends]
    report = reports.summarise(results, "left_turn", "nominal", "id", 7)
    assert report["success_rate"] == report["collision_rate"] == 0.5
    assert report["surviving_distance_m"] == {"mean": 15.0, "std": 5.0}
    assert set(report) == {
        "scenario", "condition", "episodes", "success_rate", "collision_rate",
        "surviving_distance_m", "episode_reward", "episode_time_s", "lateral_acceleration_mps2",
        "longitudinal_acceleration_mps2", "policy_id", "seed",
    }  # fmt: skip
    lateral = reports.ACCELERATIONS[0]
    unknown = replace(RESULT, lateral_acceleration_mps2=None)
    for values, mean in (([unknown], None), ([unknown, RESULT], 0.0)):
        report = reports.summarise(values, "any", "nominal", "id", 0)
        assert report[lateral]["mean"] == mean
    with pytest.raises(ValueError, match="no episode"):
        reports.summarise([], "left_turn", "nominal", "id", 7)


def test_a_limit_of_steps_is_a_timeout_as_soon_as_another_episode_tells_its_end():
    for outcomes, success, settled in (
        (["truncated", "goal", "truncated"], 1 / 3, ["timeout", "goal", "timeout"]),
        (["failed", "truncated", "ended"], 0.0, ["failed", "timeout", "ended"]),
        (["truncated", "ended"], None, ["truncated", "ended"]),
        (["truncated", "stopped"], None, ["truncated", "stopped"]),
    ):
        report = report_of(outcomes)
        assert [row["outcome"] for row in report["per_episode"]] == settled
        assert report["success_rate"] == success


def test_no_progress_tells_of_less_than_nothing_to_come(capsys):
    with ProgressBar("training", 10) as bar:
        bar.advance({"return": "3.0"}, 14)  # An episode is driven to its end.
    assert capsys.readouterr().err == "training: 14/10  return 3.0  ETA 0 s\n"


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


T_S, REPORT_S = 0.1, 0.05
STEPS = 120


def asked_at(step):
    return float(np.clip(0.7 * math.sin(0.31 * step) + 0.5 * math.sin(0.113 * step), -1, 1))


def ns(time_s):
    return round((5.0 + time_s) * 1e9)


def log_of(reached, episodes=2):
    """The log of a vehicle that has reached ``reached(t)`` at t, in each of the episodes."""
    log = reports.TrackingLog()
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
    log = reports.TrackingLog()
    log.begin()
    return log


@pytest.mark.parametrize("delay_s", [0.0, 0.06, 0.4])
def test_a_delay_is_found(delay_s):
    report = log_of(lambda time_s: held(time_s - delay_s)).report(["pedal"])
    assert (report["action_error"]["pedal"]["max"] > 0.0) == (delay_s > 0.0)
    # Asked and reached are steps here: all delays between two reports are as good.
    assert report["lag_ms"]["pedal"] == pytest.approx(delay_s * 1e3, abs=REPORT_S / 2 * 1e3)


@pytest.mark.parametrize(("dead_s", "constant_s"), [(0.02, 0.05), (0.1, 0.1), (0.2, 0.3)])
def test_a_lag_lies_between_the_dead_time_and_its_sum_with_the_time_constant(dead_s, constant_s):
    lag_s = log_of(follower(dead_s, constant_s)).report(["pedal"])["lag_ms"]["pedal"] / 1e3
    half_s = REPORT_S / 2
    assert dead_s + 0.5 * constant_s - half_s < lag_s < dead_s + constant_s + half_s


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
    assert report["lag_ms"] == {"speed": pytest.approx(200, abs=1e3 * reports.LAG_STEP_S)}
    assert report["speed_error_mps"]["max"] == pytest.approx(2 * math.sin(0.2), abs=0.01)


def test_what_was_not_measured_is_none():
    none = {"rmse": None, "max": None}
    assert set(reports.quantiles([]).values()) == {None}
    report = log_of(lambda time_s: 0.5).report(["pedal"])
    assert report["speed_error_mps"] == none
    assert report["lag_ms"]["speed"] is None
    nothing = reports.TrackingLog().report(["pedal"])
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
