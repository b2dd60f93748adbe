"""The vehicle campaign: a rig of real processes, the same loop in virtual time, and its sums."""

import json

import pytest

from edge_runtime.cli import run_cli
from hil_tests.__main__ import main
from hil_tests.mock_hunter.body import make_parameters
from hil_tests.processes import POLICY
from hil_tests.report import lag_sentence, render_comparison, render_sweep
from hil_tests.sweep import LAG_AXES, LAGS, VEHICLE, Lag, Task
from hil_tests.vehicle import cost, join_vehicles, lag_budget, lag_row, loop_row, run_rig
from hil_tests.virtual_drive import Driven, VirtualDrive
from trainer.drivers import OnnxDriver, make_environment

SHORT_TOY = "bridge.tests.toy:BridgeToyShort-v0"


def test_a_rig_drives_a_hunter_over_can_and_the_simulator_follows_it():
    task = Task(POLICY, "any", SHORT_TOY, "nominal", 0, 1, changes={"dead_time_s": 0.1})
    for _ in range(3):  # A busy machine may pause a process for over 2 T.
        report = run_rig(task, VEHICLE)
        if not report["safe_stops"]:
            break
    vehicle = report["vehicle"]
    assert report["loop"] == "vehicle"
    assert (vehicle["name"], vehicle["moving_starts"]) == ("hunter", 0)
    assert vehicle["scale"] == pytest.approx(0.25)
    assert vehicle["samples"] > 20
    assert vehicle["speed_error_mps"]["max"] > 0.01
    assert 0.0 < vehicle["lag_ms"]["speed"] < 1000.0
    assert report["rejected_by_simulator"] == {}


def drive_virtually(seeds, **changes):
    env = make_environment("left_turn")
    drive = VirtualDrive(env, OnnxDriver(POLICY), make_parameters("hunter-2.0", changes))
    return [drive.episode(seed) for seed in seeds], drive.tracking.report(drive.action_names)


def test_in_virtual_time_the_same_seed_is_the_same_drive():
    driven, tracking = drive_virtually([3])
    assert driven == drive_virtually([3])[0]
    assert (driven[0].outcome, driven[0].stops) == ("goal", 0)
    assert tracking["scale"] == pytest.approx(0.25)


def test_the_lag_that_is_measured_grows_with_the_actuators():
    lags_ms = [
        drive_virtually([3], **changes)[1]["lag_ms"]["speed"]
        for changes in ({}, {"dead_time_s": 0.2}, {"speed_time_constant_s": 0.4})
    ]
    # 30 ms of dead time and a time constant of 100 ms, and on the way up to a frame each way.
    assert 100 <= lags_ms[0] <= 170
    assert lags_ms[1] == pytest.approx(lags_ms[0] + 170, abs=30)
    assert lags_ms[2] > lags_ms[0] + 100


def test_a_vehicle_that_cannot_follow_is_stopped_by_its_driver():
    driven, _ = drive_virtually([0], dead_time_s=3.0)
    assert driven[0].stops >= 1
    assert driven[0].outcome != "goal"


def test_every_point_of_the_lines_is_a_point_of_the_table():
    specs = {lag.spec for lag in LAGS}
    for axis in LAG_AXES:
        assert {axis.spec(value) for value in axis.values} <= specs
        assert axis.base == axis.spec(axis.values[0])
        assert list(axis.values) == sorted(axis.values)


def row_at(dead_ms, constant_ms, goals, lag_ms=None, stops=0):
    outcomes = ["goal"] * goals + ["collision"] * (20 - goals)
    driven = [Driven(seed, outcome, 20.0, 8.0, stops) for seed, outcome in enumerate(outcomes)]
    tracking = {"lag_ms": {"speed": lag_ms}, "speed_error_mps": {"rmse": 0.1, "max": 0.2}}
    return lag_row(Lag(dead_ms, constant_ms), driven, tracking)


def test_the_lag_budget_is_the_sum_up_to_which_every_point_holds():
    rows = [
        row_at(0, 100, 20, 90), row_at(200, 100, 19, 280), row_at(0, 400, 20, 310),
        row_at(400, 100, 18, 460), row_at(300, 500, 20, 700),
    ]  # fmt: skip
    found = lag_budget(rows, 0.95)
    assert (found["sum_ms"], found["measured_ms"], found["all_hold"]) == (400, 310, False)
    sentence = lag_sentence({"lag_budget": found})
    assert "sum up to 400 ms or less (measured: 310 ms)" in sentence
    assert "every lag that was tested" in lag_sentence({"lag_budget": lag_budget(rows[:3], 0.95)})
    none = lag_budget([row_at(0, 100, 1, 90), *rows[1:]], 0.95)
    assert none["sum_ms"] is None
    assert "below 95% success at the least lag" in lag_sentence({"lag_budget": none})


def test_the_table_shows_lags_that_were_not_told_as_such():
    rows = {row["spec"]: row for row in (row_at(0, 100, 20, 90), row_at(50, 200, 10, None, 1))}
    sweep = {
        "rows": rows, "runs": 20, "budget": None,
        "lag_budget": lag_budget(list(rows.values()), 0.95),
    }  # fmt: skip
    text = render_sweep(sweep, {"table": "r_table.png"})
    assert "| 100 | 100% (90) | - |" in text
    assert "| 200 | - | 50%* (-) |" in text


def report_of(seed, outcomes, times_s, vehicle=None):
    return {
        "loop": "vehicle" if vehicle else "policy", "seed": seed, "command": "c", "wall_s": 9.0,
        "per_episode": [
            {"seed": seed + n, "outcome": o, "distance_m": 20.0, "time_s": t, "steps": 80}
            for n, (o, t) in enumerate(zip(outcomes, times_s, strict=True))
        ],
        "latency_ms": {"p50": 1.0, "p99": 4.0}, "deadline_misses": 0, "tick_overruns": 1,
        "rejected": {}, "safe_stops": 1, "safe_stop_events": [{"reason": "no_feedback"}],
        "vehicle": vehicle,
    }  # fmt: skip


def vehicle_of(samples, rmse, lag_ms):
    return {
        "name": "hunter", "scale": 0.25, "samples": samples,
        "speed_error_mps": {"rmse": rmse, "max": 2 * rmse},
        "action_error": {
            "pedal": {"rmse": rmse, "max": 1.0}, "steering": {"rmse": None, "max": None},
        },
        "lag_ms": {"speed": lag_ms, "pedal": None},
        "feedback_age_ms": {"p50": 20.0, "p99": 50.0 + samples}, "faults": {"link": 2},
        "moving_starts": 1,
    }  # fmt: skip


def test_errors_of_several_rigs_are_pooled_by_their_samples():
    found = join_vehicles([vehicle_of(100, 0.3, 120.0), vehicle_of(300, 0.1, 140.0)])
    assert found["speed_error_mps"]["rmse"] == pytest.approx((0.25 * 0.09 + 0.75 * 0.01) ** 0.5)
    assert found["speed_error_mps"]["max"] == 0.6
    assert found["action_error"]["steering"] == {"rmse": None, "max": None}
    assert found["lag_ms"] == {"speed": 130.0, "pedal": None}
    assert (found["feedback_age_ms"]["p99"], found["faults"]) == (350.0, {"link": 4})


def test_the_cost_counts_seeds_that_both_loops_bring_to_the_goal():
    policy = loop_row("policy", [report_of(0, ["goal", "goal", "timeout"], [8.0, 9.0, 20.0])])
    vehicle = loop_row(
        "vehicle",
        [
            report_of(2, ["goal"], [9.0], vehicle_of(10, 0.1, 100.0)),
            report_of(0, ["goal", "collision"], [8.5, 3.0], vehicle_of(10, 0.1, 100.0)),
        ],
    )
    found = cost(policy["per_episode"], vehicle["per_episode"])
    assert (found["seeds"], found["longer_s"]["value"]) == (1, 0.5)
    assert vehicle["safe_stop_reasons"] == {"no_feedback": 2}
    comparison = {
        "scenario": "left_turn", "rows": {"policy": policy, "vehicle": vehicle}, "cost": found,
        "target_success": 0.95, "holds": False,
    }  # fmt: skip
    text = render_comparison(comparison)
    assert "in 67% (21% to 94%) of 3 episodes: the bar of 95% is NOT met." in text
    assert "| actuator lag, ms | - | speed 100, pedal - |" in text


def test_the_sweep_as_a_command(tmp_path):
    out = tmp_path / "r.json"
    options = ["--only", "sweep", "--runs", "2", "--jobs", "1", "--lags", "50+100", "--seed", "3"]
    assert run_cli(main, ["vehicle", *options, "--out", str(out)]) == 0
    sweep = json.loads(out.read_text())["sweep"]
    assert sweep["rows"]["dead=50ms,constant=100ms"]["outcomes"] == {"goal": 2}
    assert (tmp_path / sweep["figures"]["table"]).stat().st_size > 5000
    (kept,) = (tmp_path / "r_rows").iterdir()
    row = json.loads(kept.read_text())
    kept.write_text("{")
    assert run_cli(main, ["vehicle", *options, "--out", str(out)]) == 2
    kept.write_text(json.dumps({**row, "outcomes": {"kept": 2}}))
    assert run_cli(main, ["vehicle", *options, "--out", str(out)]) == 0
    again = json.loads(out.read_text())["sweep"]
    assert again["rows"]["dead=50ms,constant=100ms"]["outcomes"] == {"kept": 2}
    assert "| 100 | 100% (" in (tmp_path / "r.md").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--lags", "50"], "'50' is no lag"),
        (["--lags", "50+0"], "'50+0' is no lag"),
        (["--set", "dead_time_s"], "use NAME=VALUE"),
        (["--set", "colour=1"], "no parameter 'colour'"),
        (["--policy", "nothing.onnx"], "nothing.onnx"),
        (["--public-key", "nothing.pub"], "public key nothing.pub does not exist"),
    ],
)
def test_bad_input_is_one_line(options, words, tmp_path, capsys):
    arguments = ["vehicle", "--out", str(tmp_path / "r.json"), "--only", "sweep", *options]
    assert run_cli(main, arguments) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
