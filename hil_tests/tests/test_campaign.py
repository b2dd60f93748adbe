"""The campaigns: what they say of their rows, each driven once, and a rig of real processes."""

import json
from typing import Any
from unittest import mock

import pytest

from edge_runtime.cli import run_cli
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from hil_tests import campaign as reports
from hil_tests import sweep
from hil_tests.__main__ import main
from hil_tests.faults.rig import free_bus
from hil_tests.processes import (
    POLICY,
    CommandTimeoutError,
    Process,
    operator,
    trusting,
    wait_until,
)  # fmt: skip
from hil_tests.testing.drives import SHORT_TOY

DELAY = sweep.Axis("delay", "delay", "ms", (0, 50, 100, 150), "delay={}ms", "none", "{} of delay")
LOSS = sweep.Axis("loss", "loss", "%", (0, 10), "loss={}%", "none", "{} of loss")
JITTER = sweep.Axis("jitter", "jitter", "ms", (0, 9), "delay=1ms,jitter={}ms", "delay=1ms", "{}")


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
            "on delay=1ms alone it is below 98% success: no jitter has a budget.",
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


def report_of(seed, outcomes, p99=4.0):
    """What `bridge simulate` writes, in parts."""
    return {
        "command": "c", "wall_s": 9.0,
        "per_episode": [
            {"seed": seed + n, "outcome": o, "distance_m": 20.0, "time_s": 2.0, "steps": 20}
            for n, o in enumerate(outcomes)
        ],
        "latency_ms": {"p50": 1.0, "p99": p99}, "deadline_misses": 10,
        "rejected": {"stale": 2}, "safe_stops": 1, "safe_stop_events": [{"reason": "no_feedback"}],
    }  # fmt: skip


def row_of(*parts):
    return sweep.make_row("s", [sweep.worth_keeping(part) for part in parts])


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
    assert row["episode_time_s"] == 2.0
    assert row["surviving_distance_m"]["value"] == 20.0


def test_a_campaign_through_real_processes_resumes_where_it_was(tmp_path, monkeypatch, capsys):
    few = sweep.Axis("delay", "delay", "ms", (0, 100), "delay={}ms", "none", "{} of delay")
    monkeypatch.setattr(sweep, "NETWORK_AXES", (few,))
    monkeypatch.chdir(tmp_path)  # The default policy is the repository's.
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
    drive_network = mock.Mock(side_effect=no_drive)
    monkeypatch.setattr(sweep, "drive_network", drive_network)
    assert run_cli(main, arguments) == 0
    assert json.loads(out.read_text())["latency"]["rows"] == first["rows"]
    next((tmp_path / "r_rows").iterdir()).unlink()
    assert run_cli(main, arguments) == 2
    assert drive_network.call_count == 1


def test_a_drive_is_driven_anew_or_in_halves_and_not_for_ever(monkeypatch):
    task = sweep.Task(POLICY, "any", "left_turn", "nominal", 1, 3)
    answers: list[Any] = []
    driven: list[tuple[int, int]] = []

    def rig(_, part):
        driven.append(part[1:])
        if isinstance(answer := answers.pop(0), Exception):
            raise answer
        report = report_of(part.seed, ["goal"] * part.runs)
        return {**report, "success_rate": 1.0, "wall_clock_stalls": answer}

    monkeypatch.setattr(sweep, "run_rig", rig)
    for passing in (CommandTimeoutError("hangs"), UserError("port 1 is in use")):
        driven.clear()
        answers[:] = [passing, 1, 0, 0]
        found = sweep.drive_network(task, sweep.Part("none", 1, 3))
        assert driven == [(1, 3), (1, 3), (1, 2), (3, 1)]
        assert [each["seed"] for part in found for each in part["episodes"]] == [1, 2, 3]
    for bad, said in (([1] * 9, "too little processor time"), ([UserError("no such")], "no such")):
        answers[:] = bad
        with pytest.raises(UserError, match=said):
            sweep.drive_network(task, sweep.Part("none", 1, 1))
    with (
        pytest.raises(CommandTimeoutError, match=r"did not end within 0\.1 s"),
        Process("http.server", "0", "--bind", "127.0.0.1") as process,
    ):
        process.wait(0.1)
    assert process.has_ended


def test_a_process_has_crashed_where_nobody_ended_it():
    with (
        Process("json.tool", "nowhere") as failed,
        Process("http.server", "0", "--bind", "127.0.0.1") as ended,
    ):
        wait_until(lambda: failed.has_ended, "its end")
        ended.end()
        assert (failed.crashed(), ended.crashed()) == (True, False)


def test_an_environment_that_knows_no_success_has_no_campaign(monkeypatch, tmp_path):
    monkeypatch.setattr(sweep, "run_rig", lambda *_, **__: {"success_rate": None})
    task = sweep.Task(POLICY, "any", "Pendulum-v1", "nominal", 1, 1)
    with pytest.raises(UserError, match="Pendulum-v1 says of no episode whether it succeeded"):
        sweep.drive_all(task, ["none"], 1, tmp_path / "kept")


def test_a_limit_of_steps_is_a_timeout_in_a_campaign(monkeypatch, tmp_path):
    def rig(_, part):
        ends = ["truncated"] * 2 if part.point == "delay=1s" else ["timeout", "goal"]
        success = None if part.point == "delay=1s" else 0.5
        return {**report_of(part.seed, ends), "success_rate": success, "wall_clock_stalls": 0}

    monkeypatch.setattr(sweep, "run_rig", rig)
    monkeypatch.setattr(
        sweep,
        "in_parallel",
        lambda work, parts, _, done: [done(one, work(one)) for one in parts],
    )
    task = sweep.Task(POLICY, "any", "Pendulum-v1", "nominal", 1, 2)
    found = sweep.drive_all(task, ["none", "delay=1s"], 1, tmp_path / "kept")
    rows = {point: sweep.make_row(point, parts)["outcomes"] for point, parts in found.items()}
    assert rows == {"none": {"timeout": 1, "goal": 1}, "delay=1s": {"timeout": 2}}
    with pytest.raises(UserError, match="says of no episode whether it succeeded"):
        sweep.drive_all(task, ["delay=1s"], 1, tmp_path / "others")


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


def drive_hunter(folder):
    """The simulator's report of a drive with a mock Hunter in the loop, and an operator beside."""
    endpoint, bus, config = free_endpoint(), free_bus(), folder / "edge.toml"
    config.write_text(f'[vehicle.hunter]\nbus = "{bus}"\n')
    common = ("--vehicle-id", "hunter")
    chassis = ("hil_tests", "mock_hunter", "--bus", bus, "--set=dead_time_s=0.1")
    edge = ("edge_runtime", "run", *trusting(POLICY, None), "--connect", endpoint, *common)
    with (
        sweep.Process(*chassis, ready="ready"),
        sweep.Process(*edge, "--vehicle", "hunter", "--config", str(config), ready="ready"),
        operator(endpoint, "hunter"),
    ):
        drive = ("--env", SHORT_TOY, "--clock", "realtime", "--loop", "vehicle", "--standing")
        return sweep.simulate(endpoint, folder / "r.json", 120.0, *common, *drive)


def test_a_rig_drives_a_hunter_over_can_and_the_simulator_follows_it(tmp_path):
    for _ in range(3):  # A busy machine may pause a process for over 2 T.
        report = drive_hunter(tmp_path)
        if not report["safe_stops"]:
            break
    vehicle = report["vehicle"]
    assert (report["loop"], vehicle["name"], vehicle["moving_starts"]) == ("vehicle", "hunter", 0)
    assert vehicle["samples"] > 20
    assert vehicle["speed_error_mps"]["max"] > 0.01
    assert 0.0 < vehicle["lag_ms"]["speed"] < 1000.0
    assert report["rejected_by_simulator"] == {}
