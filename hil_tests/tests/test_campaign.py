"""The latency campaign: what it says of its rows, that it drives each once, and its two files."""

import json
from itertools import chain, repeat
from pathlib import Path

import pytest

from edge_runtime.cli import run_cli
from edge_runtime.util import UserError
from hil_tests import campaign
from hil_tests.__main__ import main
from hil_tests.campaign import Chunk
from hil_tests.report import check_report, write_report
from hil_tests.sweep import NETWORK_AXES, Axis, Task, budget, limit_of, make_row, turns

DELAY = Axis("delay", "delay", "ms", (0, 50, 100, 150), "delay={}ms", "none", "{} of delay")
LOSS = Axis("loss", "loss", "%", (0, 10), "loss={}%", "none", "{} of loss")


def rows_of(axis, *success):
    return {
        axis.spec(value): {"success": {"value": share}}
        for value, share in zip(axis.values, success, strict=True)
    }


@pytest.mark.parametrize(
    ("success", "limit"),
    [
        ((1.0, 0.99, 0.98, 0.97), 100),
        ((1.0, 0.97, 1.0, 1.0), 0),  # What holds further out does not count: one may land between.
        ((0.97, 1.0, 1.0, 1.0), None),
        ((1.0, 1.0, 1.0, 1.0), 150),
    ],
)
def test_the_limit_is_the_largest_value_up_to_which_all_hold(success, limit):
    assert limit_of(DELAY, rows_of(DELAY, *success), 0.98) == limit


def test_the_sentence_says_what_was_only_the_end_of_the_table():
    rows = {**rows_of(DELAY, 1.0, 1.0, 0.9, 0.9), **rows_of(LOSS, 1.0, 1.0)}
    found = budget([DELAY, LOSS], rows, 0.98, "a policy")
    assert found["sentence"] == (
        "a policy holds at least 98% success up to 50 ms of delay and "
        "10 % of loss (the most that was tested), one at a time."
    )
    assert found["up_to_the_largest_tested"] == {"delay": False, "loss": True}


def test_a_policy_that_fails_without_any_network_has_no_budget():
    found = budget([DELAY], rows_of(DELAY, 0.9, 1.0, 1.0, 1.0), 0.98, "a policy")
    assert found["sentence"] == "a policy is below 98% success even on a perfect network."


def test_an_axis_whose_own_base_fails_has_no_limit_and_takes_nothing_from_the_others():
    jitter = Axis("jitter", "jitter", "ms", (0, 9), "delay=1ms,jitter={}ms", "delay=1ms", "{}")
    rows = {**rows_of(LOSS, 1.0, 0.9), **rows_of(jitter, 0.9, 1.0)}
    assert budget([LOSS, jitter], rows, 0.98, "a policy")["sentence"] == (
        "a policy holds at least 98% success up to none of loss, one at a time; "
        "on delay=1ms alone it is below that, so no jitter has a budget."
    )


def test_every_axis_can_be_read_and_begins_without_trouble():
    for axis in NETWORK_AXES:
        assert axis.values[0] == 0
        assert list(axis.values) == sorted(axis.values)
        specs = [axis.spec(value) for value in axis.values]
        assert len(set(specs)) == len(specs)
    delays = next(axis.values for axis in NETWORK_AXES if axis.name == "delay")
    assert {0, 25, 250} <= set(delays)  # 0 to 500 ms there and back


def test_turns_cover_each_seed_once():
    assert turns(seed=7, runs=60, size=25) == [(7, 25), (32, 25), (57, 10)]


def chunk_report(outcomes, p99):
    episodes = [
        {"seed": n, "outcome": outcome, "distance_m": 20.0 + n, "time_s": 2.0, "steps": 20}
        for n, outcome in enumerate(outcomes)
    ]
    return {
        "episodes": episodes,
        "latency_ms": {"p50": 100.0, "p99": p99},
        "rejected": {"stale": 2},
        "safe_stops": 3,
        "deadline_misses": 10,
        "wall_s": 0.5,
        "command": "c",
    }


def test_a_row_joins_its_chunks():
    chunks = [chunk_report(["goal"] * 8, 110.0), chunk_report(["collision"] * 2, 130.0)]
    row = make_row("s", chunks)
    # Wilson's 95 % interval of 8 in 10.
    assert row["success"] == pytest.approx(
        {"value": 0.8, "low": 0.49016, "high": 0.94331}, abs=1e-5
    )
    assert row["collision_rate"] == 0.2
    assert row["safe_stops_per_episode"] == 0.6
    assert row["ticks_without_new_command"] == 0.1
    assert row["latency_ms"] == {"p50": 100.0, "p99": 130.0}
    assert row["rejected"] == {"stale": 4}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rows", "lag", "--only", "latency"], "no latency axis 'lag'"),
        (["--rows", "delay,edge_kiled"], "no fault 'edge_kiled'"),
        (["--rows", "delay", "--only", "faults"], "no fault"),
        (["--against", "r.json"], "write NAME=R.json"),
        (["--against", "a=results/latency/left_turn/realtime.json"], "with its budget"),
        (["--policy", "nowhere.onnx", "--only", "latency"], "nowhere.onnx"),
    ],
)
def test_a_mistake_is_one_line(options, said, tmp_path, capsys):
    assert run_cli(main, ["campaign", "--out", str(tmp_path / "r.json"), *options]) == 2
    errors = capsys.readouterr().err.strip()
    assert said in errors
    assert "\n" not in errors
    assert list(tmp_path.iterdir()) == []


def test_another_campaigns_sentence_has_the_name_that_it_is_shown_by():
    name, latency_part = campaign._other("without_1=results/latency/left_turn/shipped.json")
    assert latency_part["policy"].endswith("left_turn.onnx")
    assert latency_part["budget"]["sentence"].startswith(f"{name} holds at least 98%")


def test_one_episode_has_no_interval_that_a_report_could_hold(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["campaign", "--out", str(tmp_path / "r.json"), "--runs", "1"])
    assert ended.value.code == 2
    assert "2 or more have an interval" in capsys.readouterr().err


def test_a_key_that_is_not_there_is_said_before_anything_is_driven(tmp_path, capsys):
    options = ["--only", "latency", "--public-key", "nothing.pub"]
    assert run_cli(main, ["campaign", "--out", str(tmp_path / "r.json"), *options]) == 2
    assert "public key nothing.pub does not exist" in capsys.readouterr().err


def test_a_campaign_through_real_processes_resumes_where_it_was(tmp_path, monkeypatch, capsys):
    few = Axis("delay", "delay", "ms", (0, 100), "delay={}ms", "none", "{} of delay")
    monkeypatch.setattr(campaign, "NETWORK_AXES", (few,))
    out = tmp_path / "r.json"
    arguments = ["campaign", "--only", "latency", "--runs", "2", "--jobs", "2", "--out", str(out)]
    assert run_cli(main, arguments) == 0
    first = json.loads(out.read_text())["latency"]
    assert set(first["rows"]) == {"none", "delay=100ms"}
    assert first["rows"]["delay=100ms"]["latency_ms"]["p50"] > 200
    assert all((tmp_path / name).stat().st_size > 10_000 for name in first["figures"].values())
    assert first["budget"]["sentence"] in capsys.readouterr().out
    assert first["budget"]["sentence"] in out.with_suffix(".md").read_text()

    driven: list[Chunk] = []

    def note(task, chunks, *_):
        driven.extend(chunks)
        raise UserError("drives nothing")

    monkeypatch.setattr(campaign, "drive_chunks", note)
    assert run_cli(main, arguments) == 0
    assert json.loads(out.read_text())["latency"]["rows"] == first["rows"]
    Path(next((tmp_path / "r_rows").iterdir())).unlink()
    assert run_cli(main, arguments) == 2
    assert len(driven) == 1


def test_a_drive_without_end_is_driven_again_beside_a_fresh_edge_runtime(monkeypatch):
    policy = Path("results/policies/left_turn.onnx")
    task = Task(policy, "any", "left_turn", "nominal", 1, 1)
    edges, limits_s = [], chain((0.1,), repeat(120.0))
    start_edge, wait = campaign.Worker.start_edge, campaign.BackgroundCommand.wait

    def note_edge(worker):
        start_edge(worker)
        edges.append(worker.edge)

    monkeypatch.setattr(campaign.Worker, "start_edge", note_edge)
    monkeypatch.setattr(
        campaign.BackgroundCommand, "wait", lambda self, _limit_s: wait(self, next(limits_s))
    )
    reports = []
    chunk = Chunk("none", 1, 1)
    campaign.drive_chunks(task, [chunk], 1, lambda _chunk, found: reports.append(found))
    assert [len(part["episodes"]) for report in reports for part in report["parts"]] == [1]
    assert len(edges) == 2


def test_the_markdown_stands_beside_the_json(tmp_path):
    out = tmp_path / "r.json"
    check_report(out)
    write_report(out, {"passed": True}, ["# Campaign", "", "all", ""])
    assert json.loads(out.read_text()) == {"passed": True}
    assert (tmp_path / "r.md").read_text() == "# Campaign\n\nall\n"


def test_what_could_not_be_written_is_said_before_the_work(tmp_path):
    with pytest.raises(UserError, match=r"r\.md is for the JSON"):
        check_report(tmp_path / "r.md")
    (tmp_path / "r.md").mkdir()
    with pytest.raises(UserError, match="is a directory"):
        check_report(tmp_path / "r.json")
