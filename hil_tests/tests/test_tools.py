"""The doctor, boards that are not there, the bench's table, the mutants' judge, and mistakes."""

import importlib
import os
import socket
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from edge_runtime.tests.harness import exit_status
from edge_runtime.util import UserError
from hil_tests import board as boards
from hil_tests import doctor
from hil_tests.__main__ import main
from hil_tests.bench_loop import compare, rows
from hil_tests.board import BOARDS, FAULTS, prove, why_not
from hil_tests.mutation.mutants import ACCEPTED, Mutant, judge, read_accepted
from trainer.util import find_chromium

ROOT = Path(__file__).parents[2]
BY_NAME = {check.name: check for check in doctor.CHECKS}


def found(probe, group="group"):
    return doctor.examine(doctor.Check(group, "thing", probe, "no driving", "buy one"))


def test_the_basics_work_where_the_tests_run_and_every_check_has_a_remedy(capsys):
    assert main(["doctor", "--only", "basics"]) == 0
    said = capsys.readouterr().out
    assert "  missing  " not in said
    assert said.endswith("The basics work. Nothing is missing.\n")
    assert all(check.without and check.remedy for check in doctor.CHECKS)
    assert len(BY_NAME) == len(doctor.CHECKS)


def test_without_packages_it_still_runs_and_says_what_is_missing():
    # -S: no site-packages, as in a fresh clone.
    command = [sys.executable, "-S", "-m", "hil_tests", "doctor", "--only", "basics"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1, done.stderr
    assert done.stderr == ""
    assert "  ok       Python: 3." in done.stdout
    (packages,) = (line for line in done.stdout.splitlines() if "missing  packages: " in line)
    assert {"cryptography", "numpy", "torch"} <= set(packages.replace(",", "").split())
    assert done.stdout.endswith("The basics do not work here: packages, loopback.\n")
    assert "  missing  loopback: Python finds no module " in done.stdout
    assert "firewall" not in done.stdout


def test_programs_and_modules_are_tried(monkeypatch, tmp_path):
    for probe in (
        partial(importlib.import_module, "no_such_package"),
        partial(doctor.python_says, "import no_such_package.part"),
    ):
        finding = found(probe)
        assert finding.detail == "Python finds no module no_such_package"
        assert finding.remedy == "make install"
    with pytest.raises(UserError, match="ZeroDivisionError"):
        doctor.python_says("1 / 0")
    tool = tmp_path / "tool"
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    for script, says in (
        ("echo tool 1.2\necho second line", "tool 1.2"),
        ("echo broken >&2\nexit 3", "tool: broken"),
    ):
        tool.write_text(f"#!/bin/sh\n{script}\n")
        tool.chmod(0o755)
        assert found(partial(doctor.program_says, "tool")).detail == says
    assert found(partial(doctor.program_says, "toool")).detail == "toool is not installed"


def test_the_browser_that_is_found_is_the_one_that_the_tests_use(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not doctor.examine(BY_NAME["Chromium"]).ok
    assert find_chromium() is None
    browser = tmp_path / "google-chrome-stable"
    browser.write_text("#!/bin/sh\necho Chrome 1\n")
    browser.chmod(0o755)
    assert doctor.examine(BY_NAME["Chromium"]).detail == "Chrome 1"
    assert find_chromium() == str(browser)


def test_a_directory_that_takes_no_file_and_a_full_disk(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert doctor.examine(BY_NAME["disk"]).ok
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(doctor, "DISK_GB", 10**9)
    assert "are wanted" in doctor.examine(BY_NAME["disk"]).detail
    monkeypatch.chdir("/proc")
    assert not doctor.examine(BY_NAME["disk"]).ok


def test_python_ports_buses_and_the_display_are_tried(monkeypatch):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        probe = partial(doctor.port, other.getsockname()[1])
        taken = found(probe)
        assert not taken.ok
        assert "Address already in use" in taken.detail
    assert found(probe).ok
    said = doctor.examine(BY_NAME["CAN over UDP"]).detail
    assert said == "a frame went through UDP multicast on loopback"
    monkeypatch.setattr(doctor, "OLDEST", (99, 0))
    assert not doctor.examine(BY_NAME["Python"]).ok
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    assert "neither DISPLAY" in doctor.examine(BY_NAME["window"]).detail
    monkeypatch.setenv("DISPLAY", ":4711")
    assert ":4711" in doctor.examine(BY_NAME["window"]).detail
    assert not doctor.examine(BY_NAME["window"]).ok


def test_packages_are_asked_for(monkeypatch, tmp_path):
    project = '[project]\ndependencies = ["numpy>=1", "no-such-thing!=1.2"]\n'
    (tmp_path / "pyproject.toml").write_text(project)
    lock = tmp_path / "lock.txt"
    lock.write_text("numpy==0.0.1\nno-such-thing==1.0\n")
    monkeypatch.setattr(doctor, "ROOT", tmp_path)
    monkeypatch.setattr(doctor, "LOCK", lock)
    assert doctor.examine(BY_NAME["packages"]).detail == "not installed: no-such-thing"
    assert "(locked: 0.0.1)" in doctor.examine(BY_NAME["locked versions"]).detail


def test_what_goes_wrong_in_a_check_is_its_finding():
    def probe():
        raise ImportError("libsomething.so:\n no such file")

    broken = found(probe, "basics")
    assert doctor.lines(broken).splitlines() == [
        "  missing  thing: ImportError: libsomething.so: no such file",
        "           without it: no driving",
        "           get it: buy one",
    ]
    assert doctor.summary([broken]) == "The basics do not work here: thing."
    extra, basic = found(probe), found(lambda: "there", "basics")
    assert doctor.summary([extra, basic]) == "The basics work. Missing besides: thing."
    assert doctor.summary([extra]) == "Missing: thing."
    assert doctor.summary([basic]) == "The basics work. Nothing is missing."


CUTS = 2  # The kept report (results/deploy/aarch64.json) has more.


def test_what_is_missing_is_said(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    for board in BOARDS:
        with pytest.raises(UserError, match=f"no {board} here: it needs root"):
            main(["board", "--boards", board, "--out", str(tmp_path / "r.json")])
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
    assert (service["written"], int(service["CapBnd"], 16)) == ([], 0)
    assert service["Uid"].split()[0] != "0"
    assert (service["NoNewPrivs"], service["Seccomp"]) == ("1", "2")
    assert service["can_unit"] == "exec-condition"  # no bus here: skipped, not failed


def test_ratios_have_an_interval_that_widens_where_blocks_differ():
    floor = [np.arange(1.0, 101.0)] * 4
    result = compare([block * 1.2 for block in floor], floor)
    assert result["p50"]["floor"] == pytest.approx(50.5)
    for row in result.values():
        assert [row["ratio"], *row["interval"]] == pytest.approx([1.2] * 3)
    generator = np.random.default_rng(0)
    floor = [generator.uniform(1, 2, 50) for _ in range(8)]
    ours = [block * factor for block, factor in zip(floor, np.linspace(1, 2, 8), strict=True)]
    low, high = compare(ours, floor)["p50"]["interval"]
    assert 1.0 < low < compare(ours, floor)["p50"]["ratio"] < high < 2.0
    for blocks, says in (([np.ones(3)] * 2, "2 blocks of ours beside 1"), ([], "0 blocks")):
        with pytest.raises(ValueError, match=says):
            compare(blocks, blocks[1:])


def report(ratio=1.1, end_mb=100.0, idle=0.01, start_s=1.0, times=40.0):
    quantile = {"ours": 0.3, "floor": 0.25, "ratio": ratio, "interval": [ratio, ratio]}
    memory = {"start": 99.0, "end": end_mb, "steps": 1000, "grown_after_first_tenth": 0.0}
    return {
        "latency": {"latency_ms": {"p50": quantile}},
        "process": {
            "memory_mb": memory, "floor_memory_mb": memory, "idle_load": idle,
            "first_command_s": {"median": start_s, "starts": 5},
        },
        "lockstep": {"scenario": "left_turn", "times_real_time": times},
    }  # fmt: skip


def test_every_bar_is_met_or_missed_by_its_own_figure():
    met = [row[-1] for row in rows(report()) if row[-1]]
    assert len(met) == 6
    assert all(bar.endswith("met") for bar in met)
    for missed in (
        {"ratio": 1.26}, {"end_mb": 110.1}, {"idle": 0.021}, {"start_s": 1.6}, {"times": 29.0},
    ):  # fmt: skip
        bars = [row[-1] for row in rows(report(**missed))]
        assert sum(bar.endswith("MISSED") for bar in bars) == 1


def test_each_mutant_is_killed_accepted_or_a_survivor():
    killed = Mutant("safety.py", "T = 2", "T = 3", "killed")
    alive = Mutant("safety.py", "x = 1", "x = 2", "survived")
    equal = Mutant("wire.py", "y = 0", "pass", "survived")
    reason = {"file": "wire.py", "was": "y = 0", "became": "*", "reason": "y is set again"}
    assert judge([killed, alive, equal], [reason]) == [
        "safety.py: 2 mutants, 1 killed, 0 accepted",
        "wire.py: 1 mutants, 0 killed, 1 accepted",
        "SURVIVED safety.py: `x = 1` became `x = 2`",
    ]
    assert judge([killed._replace(outcome="not run")], [])[1].startswith("SURVIVED")


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
