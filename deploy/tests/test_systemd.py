"""The unit files and the Dockerfile, and what systemd is told."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from deploy.installer.systemd import (
    CAN_UNIT,
    MAIN_UNIT,
    TRIAL_UNIT,
    HealthLimits,
    Systemd,
    UnhealthyError,
)
from edge_runtime.policy import MAX_POLICY_MIB
from hil_tests.testing.commands import run_command
from hil_tests.testing.policies import write_policy

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "deploy/systemd"
MAX_EXPOSURE = {MAIN_UNIT: 20, CAN_UNIT: 25}
"""Tenths; see `systemd-analyze security`, where 100 is a service without any protection."""


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not there (Debian's package systemd)")
    line = ["systemd-analyze", *arguments]
    return subprocess.run(line, capture_output=True, text=True, timeout=60)


def test_systemd_takes_every_line(tmp_path):
    """Of the units as the installer lays them: with a root that has the program they start."""
    program = tmp_path / "current/bin/phil-edge"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    paths = [tmp_path / name for name in MAX_EXPOSURE]
    for path in paths:
        path.write_text((UNITS / path.name).read_text().replace("/opt/phil", str(tmp_path)))
    done = analyze("verify", "--man=no", *map(str, paths))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    paths[0].write_text(paths[0].read_text().replace("WatchdogSec=", "WatchDogSec="))
    assert "WatchDogSec" in analyze("verify", "--man=no", str(paths[0])).stderr


@pytest.mark.parametrize("name", MAX_EXPOSURE)
def test_exposure(name):
    limit = f"--threshold={MAX_EXPOSURE[name]}"
    if "--offline" not in analyze("--help").stdout:
        pytest.skip("systemd-analyze security --offline came with systemd 250")
    done = analyze("security", "--offline=true", "--no-pager", limit, str(UNITS / name))
    assert done.returncode == 0, done.stdout


def settings(name: str) -> dict[str, str]:
    lines = (line.partition("=") for line in (UNITS / name).read_text().splitlines())
    return {key: value for key, equals, value in lines if equals and not key.startswith("#")}


def test_the_runtime_has_a_watchdog_limits_no_rights_and_nothing_to_write_to():
    unit = settings(MAIN_UNIT)
    promised = {"Type": "notify", "Restart": "on-failure", "User": "phil"}
    promised |= {"CapabilityBoundingSet": "", "AmbientCapabilities": "", "ProtectSystem": "strict"}
    assert promised.items() <= unit.items()
    assert not {"ReadWritePaths", "StateDirectory"} & set(unit)
    assert float(unit["WatchdogSec"]) <= 3
    tries_s = float(unit["RestartSec"]) * float(unit["StartLimitBurst"])
    assert tries_s < float(unit["StartLimitIntervalSec"])  # or the limit would never be reached
    assert not {"Requires", "BindsTo", "Requisite"} & set(unit)  # the bus is no condition
    assert "bitrate 500000" in (UNITS / CAN_UNIT).read_text()


def test_the_largest_policy_fits_the_services_memory(tmp_path):
    """Its weights are a table of which one row is looked up: that takes no time."""
    path, mib = tmp_path / "large.onnx", int(settings(MAIN_UNIT)["MemoryMax"].removesuffix("M"))
    graph = """large (uint8[batch, 2, 45, 80] frames) => (float[batch, 1] action) {
        pixels = Cast<to = 1>(frames) mean = ReduceMean<axes = [1, 2, 3], keepdims = 0>(pixels)
        row = Cast<to = 7>(mean) action = Gather(table, row)
    }"""
    write_policy(path, graph=graph)
    model = onnx.load(str(path))
    rows = ((MAX_POLICY_MIB << 20) - model.ByteSize() - 100) // 4
    table = numpy_helper.from_array(np.zeros((rows, 1), np.float32), "table")
    model.graph.initializer.append(table)
    path.write_bytes(model.SerializeToString())
    assert path.stat().st_size > (MAX_POLICY_MIB << 20) - 100
    done = run_command("check", str(path), "--allow-unsigned")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["memory_mb"] < (mib << 20) / 1e6 - 40  # the rest is `run`'s


FAKE = """\
#!{python}
import sys
program, *words = sys.argv
state = open({state!r}).read()
if program.endswith("systemd-run"):
    (said,) = [word.split("=file:")[1] for word in words if "StandardError=" in word]
    open(said, "w").write(open({log!r} + ".said").read())
    words = ["systemd-run", *words]
if words[0] == "show":
    print(state)
    sys.exit()
open({log!r}, "a").write(" ".join(words) + "\\n")
if words[0] in ("start", "systemd-run"):
    sys.exit("Job failed." if "refuse" in state else 0)
"""
ACTIVE = "ActiveState=active\nSubState=running\nNRestarts=0\nResult=success\nStatusText=standby"
LIMITS = HealthLimits(1.0, 0.1)


class Board:
    """A folder for units, and stand-ins for systemd's programs that note what they are told."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.units, self.log = folder, folder / "etc", folder / "log"
        self.systemd = Systemd(folder, self.units)

    def state(self, text: str) -> None:
        (self.folder / "state").write_text(text)

    def release(self, name: str) -> Path:
        folder = self.folder / name
        (folder / "units").mkdir(parents=True)
        for unit in MAX_EXPOSURE:
            (folder / "units" / unit).write_text(f"[Service]\nExecStart=/opt/phil/{name}\n")
        return folder

    def told(self) -> list[str]:
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines

    def try_release(self, said: str, state: str) -> None:
        (self.folder / "log.said").write_text(said)
        self.state(state)
        self.systemd.try_release(self.release("one"), "abc", LIMITS)


@pytest.fixture
def board(tmp_path, monkeypatch):
    programs = tmp_path / "programs"
    programs.mkdir()
    (tmp_path / "etc").mkdir()
    names = {"python": sys.executable, "log": str(tmp_path / "log")}
    for name in ("systemctl", "systemd-run"):
        (programs / name).write_text(FAKE.format(state=str(tmp_path / "state"), **names))
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    board = Board(tmp_path)
    board.state(ACTIVE)
    return board


def test_units_are_installed_enabled_started_and_taken_away(board):
    board.systemd.stop()
    assert board.told() == []  # there is no service yet
    board.systemd.prepare(board.release("one"))
    board.systemd.start(LIMITS)
    verbs = (f"enable {MAIN_UNIT} {CAN_UNIT}", f"reset-failed {MAIN_UNIT}", f"start {MAIN_UNIT}")
    assert board.told() == ["daemon-reload", *verbs]
    assert f"ExecStart={board.folder}/one" in (board.units / MAIN_UNIT).read_text()
    assert board.systemd.describe() == "active standby"
    board.systemd.stop()
    assert board.told() == [f"stop {MAIN_UNIT}"]
    board.systemd.remove()
    disable = f"disable --now {MAIN_UNIT} {CAN_UNIT}"
    assert board.told() == [f"stop {MAIN_UNIT}", disable, "daemon-reload"]
    assert list(board.units.iterdir()) == []


@pytest.mark.parametrize(
    "state",
    [
        ACTIVE.replace("=active", "=failed"),
        ACTIVE.replace("=active", "=activating"),
        ACTIVE.replace("NRestarts=0", "NRestarts=1"),
        "refuse",
    ],
)
def test_a_service_that_does_not_get_well_is_unhealthy(board, state):
    board.state(state)
    with pytest.raises(UnhealthyError):
        board.systemd.start(HealthLimits(0.3, 0.1))


def test_a_trial_runs_without_vehicle_and_network_and_is_taken_away(board):
    board.try_release("loaded policy_id=abc\n", ACTIVE)
    *before, run, left, gone = board.told()
    assert before == [left, gone] == [f"stop {TRIAL_UNIT}", f"reset-failed {TRIAL_UNIT}"]
    words = run.split()
    assert words[0] == "systemd-run"
    for name in ("PrivateNetwork=yes", "User=phil", "TimeoutStartSec=1.0", "NotifyAccess=main"):
        assert f"--property={name}" in words
    assert "--service-type=notify" in words
    assert len([w for w in words if "WatchdogSec" in w or "RuntimeMaxSec" in w]) == 2
    assert run.endswith("--vehicle none --connect tcp/127.0.0.1:9 --log-level warning")


@pytest.mark.parametrize(
    ("said", "state", "why"),
    [
        ("policy_id=other\n", ACTIVE, "policy"),
        ("ready\nerror: no such file\n", "refuse\nResult=exit-code", "exit-code: error: no such"),
        ("policy_id=abc\n", "ActiveState=failed\nResult=watchdog", "watchdog"),
        ("policy_id=abc\n", "ActiveState=inactive\nResult=success", "success"),
    ],
)
def test_a_trial_that_fails_says_why_and_is_taken_away(board, said, state, why):
    with pytest.raises(UnhealthyError, match=why):
        board.try_release(said, state)
    assert board.told()[-2:] == [f"stop {TRIAL_UNIT}", f"reset-failed {TRIAL_UNIT}"]


INSTRUCTIONS = re.sub(r"(?m)^#.*\n|\\\n\s*", "", (ROOT / "deploy/container/Dockerfile").read_text())
"""Of the Dockerfile: a line each, without comments."""


def only(word: str, text: str = INSTRUCTIONS.rpartition("FROM ")[2]) -> str:
    """The arguments of the only instruction of that name, in the last stage."""
    (found,) = re.findall(rf"(?m)^{word} (.*)$", text)
    return found


def test_the_image_has_no_rights_no_index_and_no_private_key(tmp_path):
    assert only("USER") == "10001:10001"
    assert not re.search(r"\b(pip|apt-get|curl|wget|ADD)\b", INSTRUCTIONS)
    assert only("COPY", INSTRUCTIONS) == "--from=install /opt/phil /opt/phil"  # no bundle
    # What comes after the installer in the same layer, as its shell runs it.
    secrets = tmp_path / "releases/1/tls"
    secrets.mkdir(parents=True)
    (secrets / "key.pem").write_text("private")
    (tmp_path / "current").symlink_to("releases/1")
    installer, _, after = only("RUN --mount=type=bind,\\S+", INSTRUCTIONS).partition(" && ")
    assert "install.pyz" in installer
    subprocess.run(["sh", "-c", after.replace("/opt/phil", str(tmp_path))], check=True, timeout=60)
    assert list(secrets.iterdir()) == []  # and there, to be mounted


def test_the_images_first_process_is_the_runtime_as_its_unit_starts_it():
    """With the words and the folder of the unit, which are proven on a board."""
    unit = settings(MAIN_UNIT)
    assert unit["ExecStart"] == " ".join(json.loads(only("ENTRYPOINT")))
    assert unit["WorkingDirectory"] == only("WORKDIR")
