"""The campaigns: what they say of their rows, that they drive each once, a rig of real processes,
and the same loop in virtual time."""

import json
from itertools import chain, repeat
from unittest import mock

import pytest

from edge_runtime.cli import run_cli
from edge_runtime.util import UserError
from hil_tests import report as reports
from hil_tests import sweep
from hil_tests.__main__ import main
from hil_tests.mock_hunter.hunter import make_parameters
from hil_tests.processes import POLICY
from hil_tests.virtual_drive import Driven, VirtualDrive
from trainer.drivers import OnnxDriver, make_environment

DELAY = sweep.Axis("delay", "delay", "ms", (0, 50, 100, 150), "delay={}ms", "none", "{} of delay")
LOSS = sweep.Axis("loss", "loss", "%", (0, 10), "loss={}%", "none", "{} of loss")
JITTER = sweep.Axis("jitter", "jitter", "ms", (0, 9), "delay=1ms,jitter={}ms", "delay=1ms", "{}")
SHORT_TOY = "bridge.tests.toy:BridgeToyShort-v0"


def rows_of(axis, *success):
    return {spec: {"success": {"value": s}} for spec, s in zip(axis.specs, success, strict=True)}


@pytest.mark.parametrize(
    ("success", "limits", "sentence"),
    [
        (
            {DELAY: (1.0, 1.0, 0.9, 0.9), LOSS: (1.0, 1.0)}, (50, 10),
            "a policy holds at least 98% success up to 50 ms of delay and "
            "10 % of loss (the most that was tested), one at a time.",
        ),
        # What holds further out does not count: one may land between.
        ({DELAY: (1.0, 0.97, 1.0, 1.0)}, (0,),
         "a policy holds at least 98% success up to none of delay, one at a time."),
        ({DELAY: (0.9, 1.0, 1.0, 1.0)}, (None,),
         "a policy is below 98% success even on a perfect network."),
        # An axis whose own base fails takes nothing from the others.
        (
            {LOSS: (1.0, 0.9), JITTER: (0.9, 1.0)}, (0, None),
            "a policy holds at least 98% success up to none of loss, one at a time; "
            "on delay=1ms alone it is below that, so no jitter has a budget.",
        ),
    ],
)  # fmt: skip
def test_the_budget_is_the_largest_value_up_to_which_all_hold(success, limits, sentence):
    rows = {one: row for axis, some in success.items() for one, row in rows_of(axis, *some).items()}
    found = sweep.budget(list(success), rows, 0.98, "a policy")
    assert found["sentence"] == sentence
    assert tuple(found["limits"].values()) == limits
    largest = {axis.name: axis.values[-1] for axis in success}
    open_ended = {name: found["limits"][name] == most for name, most in largest.items()}
    assert found["up_to_the_largest_tested"] == open_ended


def test_every_axis_gets_worse_and_parts_cover_each_seed_once():
    for axis in sweep.NETWORK_AXES:
        assert list(axis.values) == sorted(set(axis.values))
        assert len(set(axis.specs)) == len(axis.specs)
        assert axis.base == axis.specs[0]
    delays = next(axis.values for axis in sweep.NETWORK_AXES if axis.name == "delay")
    assert {0, 25, 250} <= set(delays)  # 0 to 500 ms there and back
    parts = sweep.Part("none", 7, 60).split(25)
    assert [part[1:] for part in parts] == [(7, 25), (32, 25), (57, 10)]


def report_of(seed, outcomes, times_s=None, vehicle=None, p99=4.0):
    """What `bridge simulate` writes, in parts."""
    return {
        "command": "c", "wall_s": 9.0,
        "per_episode": [
            {"seed": seed + n, "outcome": o, "distance_m": 20.0, "time_s": t, "steps": 20}
            for n, (o, t) in enumerate(zip(outcomes, times_s or repeat(2.0), strict=False))
        ],
        "latency_ms": {"p50": 1.0, "p99": p99}, "deadline_misses": 10, "tick_overruns": 1,
        "rejected": {"stale": 2}, "safe_stops": 1, "safe_stop_events": [{"reason": "no_feedback"}],
        "vehicle": vehicle,
    }  # fmt: skip


def row_of(*parts):
    return sweep.make_row("s", [sweep.worth_keeping(part) for part in parts])


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


def test_a_row_joins_its_parts():
    row = row_of(report_of(0, ["goal"] * 8, p99=110.0), report_of(8, ["collision"] * 2, p99=130.0))
    # Wilson's 95 % interval of 8 in 10.
    assert row["success"] == pytest.approx(
        {"value": 0.8, "low": 0.49016, "high": 0.94331}, abs=1e-5
    )
    assert (row["collision_rate"], row["safe_stops_per_episode"]) == (0.2, 0.2)
    assert row["safe_stop_reasons"] == {"no_feedback": 2}
    assert row["ticks_without_new_command"] == 0.1
    assert row["latency_ms"] == {"p50": 1.0, "p99": 130.0}
    assert row["rejected"] == {"stale": 4}
    # Errors of several rigs are pooled by their samples.
    found = sweep.join_vehicles([vehicle_of(100, 0.3, 120.0), vehicle_of(300, 0.1, 140.0)])
    assert found["speed_error_mps"]["rmse"] == pytest.approx((0.25 * 0.09 + 0.75 * 0.01) ** 0.5)
    assert found["speed_error_mps"]["max"] == 0.6
    assert found["action_error"]["steering"] == {"rmse": None, "max": None}
    assert found["lag_ms"] == {"speed": 130.0, "pedal": None}
    assert (found["feedback_age_ms"]["p99"], found["faults"]) == (350.0, {"link": 4})


def test_the_cost_counts_seeds_that_both_loops_bring_to_the_goal():
    policy = row_of(report_of(0, ["goal", "goal", "timeout"], [8.0, 9.0, 20.0]))
    vehicle = row_of(
        report_of(0, ["goal", "collision"], [8.5, 3.0], vehicle_of(10, 0.1, 100.0)),
        report_of(2, ["goal"], [9.0], vehicle_of(10, 0.1, 100.0)),
    )
    found = sweep.cost(policy["per_episode"], vehicle["per_episode"])
    assert (found["seeds"], found["longer_s"]["value"]) == (1, 0.5)
    comparison = {
        "scenario": "left_turn", "rows": {"policy": policy, "vehicle": vehicle}, "cost": found,
        "target_success": 0.95, "holds": False,
    }  # fmt: skip
    text = reports.render_comparison(comparison)
    assert "in 67% (21% to 94%) of 3 episodes: the bar of 95% is NOT met." in text
    assert "| actuator lag, ms | - | speed 100, pedal - |" in text


def row_at(dead_ms, constant_ms, goals, lag_ms=None, stops=0):
    outcomes = ["goal"] * goals + ["collision"] * (20 - goals)
    driven = [Driven(seed, outcome, 20.0, 8.0, stops) for seed, outcome in enumerate(outcomes)]
    tracking = {"lag_ms": {"speed": lag_ms}, "speed_error_mps": {"rmse": 0.1, "max": 0.2}}
    return sweep.lag_row(sweep.Lag(dead_ms, constant_ms), driven, tracking)


def test_the_lag_budget_is_the_sum_up_to_which_every_point_holds():
    rows = [
        row_at(0, 100, 20, 90), row_at(200, 100, 19, 280), row_at(0, 400, 20, 310),
        row_at(400, 100, 18, 460), row_at(300, 500, 20, 700),
    ]  # fmt: skip
    found = sweep.lag_budget(rows, 0.95)
    assert (found["sum_ms"], found["measured_ms"], found["all_hold"]) == (400, 310, False)
    none = sweep.lag_budget([row_at(0, 100, 1, 90), *rows[1:]], 0.95)
    assert none["sum_ms"] is None
    for budgeted, words in (
        (found, "sum up to 400 ms or less (measured: 310 ms)"),
        (sweep.lag_budget(rows[:3], 0.95), "every lag that was tested"),
        (none, "below 95% success at the least lag"),
    ):
        assert words in reports.lag_sentence({"lag_budget": budgeted})
    # The table shows lags that were not told as such.
    two = [row_at(0, 100, 20, 90), row_at(50, 200, 10, None, 1)]
    shown = {"rows": {row["spec"]: row for row in two}, "lag_budget": sweep.lag_budget(two, 0.95)}
    text = reports.render_sweep({**shown, "runs": 20})
    assert "| 100 | 100% (90) | - |" in text
    assert "| 200 | - | 50%* (-) |" in text


def test_a_campaign_through_real_processes_resumes_where_it_was(tmp_path, monkeypatch, capsys):
    few = sweep.Axis("delay", "delay", "ms", (0, 100), "delay={}ms", "none", "{} of delay")
    monkeypatch.setattr(sweep, "NETWORK_AXES", (few,))
    out = tmp_path / "r.json"
    arguments = ["campaign", "--only", "latency", "--runs", "2", "--jobs", "2", "--out", str(out)]
    assert run_cli(main, arguments) == 0
    first = json.loads(out.read_text())["latency"]
    assert set(first["rows"]) == {"none", "delay=100ms"}
    assert first["rows"]["delay=100ms"]["latency_ms"]["p50"] > 200
    assert all((tmp_path / name).stat().st_size > 10_000 for name in first["figures"].values())
    assert first["budget"]["sentence"] in capsys.readouterr().out
    assert first["budget"]["sentence"] in out.with_suffix(".md").read_text()

    no_drive = UserError("drives nothing")
    drive_network = mock.Mock(side_effect=no_drive, __name__="drive_network")  # rows are kept by it
    monkeypatch.setattr(sweep, "drive_network", drive_network)
    assert run_cli(main, arguments) == 0
    assert json.loads(out.read_text())["latency"]["rows"] == first["rows"]
    next((tmp_path / "r_rows").iterdir()).unlink()
    assert run_cli(main, arguments) == 2
    assert drive_network.call_count == 1


def test_a_drive_without_end_is_driven_again_beside_a_fresh_edge_runtime(monkeypatch):
    edges: list[str] = []
    limits_s = chain((0.1,), repeat(120.0))
    start, wait = sweep.Process.__init__, sweep.Process.wait

    def note(self, *words, **options):
        edges.extend(words[:1] if words[0] == "edge_runtime" else ())
        start(self, *words, **options)

    monkeypatch.setattr(sweep.Process, "__init__", note)
    monkeypatch.setattr(sweep.Process, "wait", lambda self, _limit_s: wait(self, next(limits_s)))
    task = sweep.Task(POLICY, "any", "left_turn", "nominal", 1, 1)
    (found,) = sweep.drive_network(task, sweep.Part("none", 1, 1))
    assert len(found["episodes"]) == 1
    assert len(edges) == 2


def test_the_markdown_stands_beside_the_json_or_that_is_said_before_the_work(tmp_path):
    out, markdown = tmp_path / "r.json", tmp_path / "r.md"
    reports.check_report(out)
    reports.write_report(out, {"passed": True}, ["# Campaign", "", "all", ""])
    assert json.loads(out.read_text()) == {"passed": True}
    assert markdown.read_text() == "# Campaign\n\nall\n"
    with pytest.raises(UserError, match=r"r\.md is for the JSON"):
        reports.check_report(markdown)
    markdown.unlink()
    markdown.mkdir()
    with pytest.raises(UserError, match="is a directory"):
        reports.check_report(out)


def test_a_rig_drives_a_hunter_over_can_and_the_simulator_follows_it():
    task = sweep.Task(POLICY, "any", SHORT_TOY, "nominal", 0, 1, changes={"dead_time_s": 0.1})
    options = ("--clock", "realtime", "--loop", "vehicle", "--standing")
    for _ in range(3):  # A busy machine may pause a process for over 2 T.
        report = sweep.run_rig(task, sweep.Part(sweep.VEHICLE, 0, 1), 120.0, *options, hunter=True)
        if not report["safe_stops"]:
            break
    vehicle = report["vehicle"]
    assert (report["loop"], vehicle["name"], vehicle["moving_starts"]) == ("vehicle", "hunter", 0)
    assert vehicle["scale"] == pytest.approx(0.25)
    assert vehicle["samples"] > 20
    assert vehicle["speed_error_mps"]["max"] > 0.01
    assert 0.0 < vehicle["lag_ms"]["speed"] < 1000.0
    assert report["rejected_by_simulator"] == {}


def drive_virtually(seed, **changes):
    env = make_environment("left_turn")
    drive = VirtualDrive(env, OnnxDriver(POLICY), make_parameters("hunter-2.0", changes))
    return drive.episode(seed), drive.tracking.report(drive.action_names)


def test_in_virtual_time_a_drive_repeats_and_its_lag_grows_with_the_actuators():
    driven, tracking = drive_virtually(3)
    assert driven == drive_virtually(3)[0]
    assert (driven.outcome, driven.stops) == ("goal", 0)
    assert tracking["scale"] == pytest.approx(0.25)
    lag_ms = tracking["lag_ms"]["speed"]
    # 30 ms of dead time and a time constant of 100 ms, and on the way up to a frame each way.
    assert 100 <= lag_ms <= 170
    dead, slow = (
        drive_virtually(3, **changes)[1]["lag_ms"]["speed"]
        for changes in ({"dead_time_s": 0.2}, {"speed_time_constant_s": 0.4})
    )
    assert dead == pytest.approx(lag_ms + 170, abs=30)
    assert slow > lag_ms + 100
    # A vehicle that cannot follow is stopped by its driver.
    lost, _ = drive_virtually(0, dead_time_s=3.0)
    assert lost.stops >= 1
    assert lost.outcome != "goal"


def test_the_sweep_as_a_command(tmp_path):
    out = tmp_path / "r.json"
    options = ["--only", "sweep", "--runs", "2", "--jobs", "1", "--lags", "50+100", "--seed", "3"]
    assert run_cli(main, ["vehicle", *options, "--out", str(out)]) == 0
    found = json.loads(out.read_text())["sweep"]
    assert found["rows"]["dead=50ms,constant=100ms"]["outcomes"] == {"goal": 2}
    (kept,) = (tmp_path / "r_rows").iterdir()
    (row,) = json.loads(kept.read_text())
    for text, status in (("{", 2), (json.dumps([{**row, "outcomes": {"kept": 2}}]), 0)):
        kept.write_text(text)
        assert run_cli(main, ["vehicle", *options, "--out", str(out)]) == status
    again = json.loads(out.read_text())["sweep"]
    assert again["rows"]["dead=50ms,constant=100ms"]["outcomes"] == {"kept": 2}
    assert "| 100 | 100% (" in (tmp_path / "r.md").read_text()
