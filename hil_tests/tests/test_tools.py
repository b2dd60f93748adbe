"""Boards that are not there (marker ``board``), the bench's table, and the judge of mutants."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from edge_runtime.tests.harness import exit_status
from edge_runtime.util import UserError
from hil_tests import board as boards
from hil_tests.__main__ import main
from hil_tests.bench_loop import compare, rows
from hil_tests.board import BOARDS, FAULTS, prove, why_not
from hil_tests.mutation.mutants import ACCEPTED, Mutant, judge, read_accepted

CUTS = 2
"""The kept report (results/deploy/aarch64.json) has more."""


@pytest.mark.parametrize("board", BOARDS)
def test_what_is_missing_is_said(board, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(UserError, match=f"no {board} here: it needs root"):
        main(["board", "--boards", board, "--out", str(tmp_path / "r.json")])


def test_a_program_that_is_missing_is_named_with_its_package(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(boards.shutil, "which", lambda name: None)
    assert why_not("aarch64").endswith("is not there (Debian's package qemu-system-arm)")


def proven(board: str) -> dict:
    if reason := why_not(board):
        pytest.skip(reason)
    kept: list[dict] = []
    prove(board, CUTS, kept.append)
    report = kept[-1]
    assert report["status"]["whole"] == "yes"
    assert report["episode"]["policy_id"] == report["status"]["policy_id"]
    assert report["episode"]["answered_states"] > 0
    assert set(report["episode"]["rejected"]) <= {"stale", "foreign_session"}  # a busy machine's
    assert not report["left_after_uninstall"]
    return report


@pytest.mark.board
@pytest.mark.timeout(600)
def test_without_systemd_under_python38_it_installs_offline_and_drives():
    assert proven("python38")["status"]["service"] == "not run by the installer"


@pytest.mark.board
@pytest.mark.timeout(7200)
def test_an_emulated_board_installs_goes_back_refuses_and_survives_power_cuts():
    report = proven("aarch64")
    assert report["status"]["service"].startswith("active")
    assert report["rolled_back"]
    changed = report["changed_bytes"]
    assert changed["refused_and_nothing_written"] == changed["tried"]
    assert set(report["faulty"]) == set(FAULTS)
    assert all(row["status"] == 1 and row["went_back"] for row in report["faulty"].values())
    assert (report["power_cuts"]["cuts"], report["power_cuts"]["broken"]) == (CUTS, [])
    service = report["service"]
    assert service["written"] == []
    assert service["Uid"].split()[0] != "0"
    assert int(service["CapBnd"], 16) == 0
    assert service["NoNewPrivs"] == "1"
    assert service["Seccomp"] == "2"
    assert service["can_unit"] == "exec-condition"  # no bus here: skipped, not failed


def test_ratios_by_hand():
    floor = [np.arange(1.0, 101.0)] * 4
    result = compare([block * 1.2 for block in floor], floor)
    assert result["p50"]["floor"] == pytest.approx(50.5)
    for row in result.values():
        assert row["ratio"] == pytest.approx(1.2)
        assert row["interval"] == pytest.approx([1.2, 1.2])


def test_blocks_that_differ_widen_the_interval():
    generator = np.random.default_rng(0)
    floor = [generator.uniform(1, 2, 50) for _ in range(8)]
    ours = [block * factor for block, factor in zip(floor, np.linspace(1, 2, 8), strict=True)]
    low, high = compare(ours, floor)["p50"]["interval"]
    assert 1.0 < low < compare(ours, floor)["p50"]["ratio"] < high < 2.0


def test_blocks_come_in_pairs():
    with pytest.raises(ValueError, match="2 blocks of ours beside 1"):
        compare([np.ones(3)] * 2, [np.ones(3)])
    with pytest.raises(ValueError, match="0 blocks"):
        compare([], [])


def report(ratio=1.1, end_mb=100.0, idle=0.01, start_s=1.0, times=40.0):
    quantile = {"ours": 0.3, "floor": 0.25, "ratio": ratio, "interval": [ratio, ratio]}
    memory = {"start": 99.0, "end": end_mb, "steps": 1000, "grown_after_first_tenth": 0.0}
    return {
        "latency": {"latency_ms": {"p50": quantile}},
        "process": {
            "memory_mb": memory,
            "floor_memory_mb": memory,
            "idle_load": idle,
            "first_command_s": {"median": start_s, "starts": 5},
        },
        "lockstep": {"scenario": "left_turn", "times_real_time": times},
    }


def test_every_bar_is_met_or_missed_by_its_own_figure():
    met = [row[-1] for row in rows(report()) if row[-1]]
    assert len(met) == 6
    assert all(bar.endswith("met") for bar in met)
    for missed in (
        {"ratio": 1.26}, {"end_mb": 110.1}, {"idle": 0.021}, {"start_s": 1.6}, {"times": 29.0},
    ):  # fmt: skip
        bars = [row[-1] for row in rows(report(**missed))]
        assert sum(bar.endswith("MISSED") for bar in bars) == 1


ROOT = Path(__file__).parents[2]
KILLED = Mutant("safety.py", "T = 2", "T = 3", "killed")
ALIVE = Mutant("safety.py", "x = 1", "x = 2", "survived")
EQUAL = Mutant("wire.py", "y = 0", "pass", "survived")
REASONED = [{"file": "wire.py", "was": "y = 0", "became": "*", "reason": "y is set again"}]


def test_each_mutant_is_killed_accepted_or_a_survivor():
    assert judge([KILLED, ALIVE, EQUAL], REASONED) == [
        "safety.py: 2 mutants, 1 killed, 0 accepted",
        "wire.py: 1 mutants, 0 killed, 1 accepted",
        "SURVIVED safety.py: `x = 1` became `x = 2`",
    ]


def test_a_mutant_that_did_not_run_is_not_killed():
    assert judge([KILLED._replace(outcome="not run")], [])[1].startswith("SURVIVED")


def test_every_file_and_line_that_is_named_is_there():
    """An entry whose line has changed since would accept nothing, and nobody would notice."""
    settings = [
        tomllib.loads(ACCEPTED.with_name(name).read_text())["cosmic-ray"]
        for name in ("core.toml", "hunter.toml")
    ]
    files = [file for each in settings for file in each["module-path"]]
    tests = [word for each in settings for word in each["test-command"].split() if ".py" in word]
    assert [path for path in (*files, *tests) if not (ROOT / path).is_file()] == []
    for entry in read_accepted():
        assert entry["file"] in files
        assert entry["reason"]
        source = (ROOT / entry["file"]).read_text()
        assert " ".join(entry["was"].split()) in " ".join(source.split()), entry


MISTAKES = {
    "campaign --out {tmp}/r.json": {
        "--rows lag --only latency": "no latency axis 'lag'",
        "--rows delay,edge_kiled": "no fault 'edge_kiled'",
        "--rows delay --only faults": "no fault",
        "--runs 1": "2 or more have an interval",
        "--policy nowhere.onnx --only latency": "nowhere.onnx",
        "--only latency --public-key no.pub": "public key no.pub does not",
    },
    "vehicle --out {tmp}/r.json": {
        "--lags 50": "'50' is no lag",
        "--lags 50+0": "'50+0' is no lag",
        "--set dead_time_s": "use NAME=VALUE",
        "--set colour=1": "no parameter 'colour'",
        "--policy nothing.onnx": "nothing.onnx",
        "--public-key no.pub": "public key no.pub does not exist",
    },
    "demo": {
        "--out {tmp}/file": "--out",
        "--out {tmp}": "holds something else",
        "--seed -3": "--seed",
        "--minutes 0": "--minutes",
        "--runs none": "--runs",
    },
    "pictures": {"x.png": "no picture 'x.png'", "--out /dev/null": "Not a directory"},
    "doctor": {"--only wheels": "choose from basics, training"},
    "mock_hunter": {
        "--bus can0": "is no CAN bus",
        "--bus udp_multicast:10.1.2.3": "is no IPv4 multicast group",
        "--bus virtual:here": "a virtual bus ends with its process",
        "--fault meteor": "no fault 'meteor'; choose from silent",
        "--fault silent@-1": "not a finite number of seconds",
        "--set wings=2": "no parameter 'wings'",
        "--set track_m": "use NAME=VALUE",
        "--model hunter-3": "invalid choice",
    },
}


@pytest.mark.parametrize(
    ("command", "options"), [(name, each) for name, some in MISTAKES.items() for each in some]
)
def test_a_mistake_is_one_line_before_anything_is_done(command, options, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert exit_status(main, f"{command} {options}".format(tmp=tmp_path).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert MISTAKES[command][options] in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
