"""The unit files and the Dockerfile: systemd takes the units as they are, and what both promise."""

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

from deploy.installer.systemd import MAIN_UNIT, TRIAL_UNIT, Limits, Systemd
from deploy.installer.verify import UnhealthyError
from edge_runtime.policy import MAX_POLICY_MIB
from hil_tests.testing.commands import run_command
from hil_tests.testing.policies import write_policy

UNITS = Path(__file__).parents[1] / "systemd"
NAMES = ("phil-edge.service", "phil-can.service")
MAX_EXPOSURE = {"phil-edge.service": 20, "phil-can.service": 25}
"""Tenths; see `systemd-analyze security`, where 100 is a service without any protection."""


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not there (Debian's package systemd)")
    line = ["systemd-analyze", *arguments]
    return subprocess.run(line, capture_output=True, text=True, timeout=60)


@pytest.fixture
def units(tmp_path):
    """The units as the installer lays them: with a root that has the program they start."""
    program = tmp_path / "current" / "bin" / "phil-edge"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for name in NAMES:
        text = (UNITS / name).read_text().replace("/opt/phil", str(tmp_path))
        (tmp_path / name).write_text(text)
    return tmp_path


def test_systemd_takes_every_line(units):
    done = analyze("verify", "--man=no", *(str(units / name) for name in NAMES))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    unit = units / NAMES[0]  # and it would say what is wrong
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchDogSec="))
    assert "WatchDogSec" in analyze("verify", "--man=no", str(unit)).stderr


@pytest.mark.parametrize("name", NAMES)
def test_exposure(name):
    limit = f"--threshold={MAX_EXPOSURE[name]}"
    options = ("security", "--offline=true", "--no-pager")
    if "--offline" not in analyze("--help").stdout:
        pytest.skip("systemd-analyze security --offline came with systemd 250")
    done = analyze(*options, limit, str(UNITS / name))
    assert done.returncode == 0, done.stdout
    assert analyze(*options, "--threshold=1", str(UNITS / name)).returncode == 1


def settings(name: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for line in (UNITS / name).read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found[key] = f"{found[key]}\n{value}" if key in found else value
    return found


def test_the_runtime_has_a_watchdog_limits_no_rights_and_nothing_to_write_to():
    unit = settings("phil-edge.service")
    promised = {"Type": "notify", "Restart": "on-failure", "User": "phil"}
    promised |= {"CapabilityBoundingSet": "", "AmbientCapabilities": "", "ProtectSystem": "strict"}
    assert promised.items() <= unit.items()
    assert not {"ReadWritePaths", "StateDirectory"} & set(unit)
    assert float(unit["WatchdogSec"]) <= 3
    tries_s = float(unit["RestartSec"]) * float(unit["StartLimitBurst"])
    assert tries_s < float(unit["StartLimitIntervalSec"])  # or the limit would never be reached
    assert unit["CPUAffinity"]
    assert {"phil-can.service", "network-online.target"} <= set(unit["After"].split())
    bus = settings("phil-can.service")  # no condition of the runtime, and at the Hunter's rate
    assert "bitrate 500000" in bus["ExecStart"]
    assert bus["CapabilityBoundingSet"] == "CAP_NET_ADMIN CAP_SYS_MODULE"
    assert "phil-can.service" in unit["Wants"]
    assert not {"Requires", "BindsTo", "Requisite"} & set(unit)


def test_the_largest_policy_fits_the_services_memory(tmp_path):
    """Its weights are a table of which one row is looked up: that takes no time."""
    path, mib = tmp_path / "large.onnx", int(settings(NAMES[0])["MemoryMax"].removesuffix("M"))
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
with open({log!r}, "a") as log:
    log.write(" ".join(words) + "\\n")
if words[0] == "show":
    print(state)
elif words[0] in ("start", "systemd-run") and "refuse" in state:
    sys.exit("Job for phil-edge.service failed.")
"""
ACTIVE = "ActiveState=active\nSubState=running\nNRestarts=0\nResult=success\nStatusText=standby"


@pytest.fixture
def systemd(tmp_path, monkeypatch):
    programs = tmp_path / "programs"
    programs.mkdir()
    names = {"python": sys.executable, "log": str(tmp_path / "log"), "state": str(tmp_path / "s")}
    for name in ("systemctl", "systemd-run"):
        (programs / name).write_text(FAKE.format(**names))
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "s").write_text(ACTIVE)
    (tmp_path / "state").mkdir()
    (tmp_path / "etc").mkdir()
    return Systemd(tmp_path, tmp_path / "etc")


def release(folder, *units: str):
    (folder / "units").mkdir(parents=True)
    for unit in units:
        text = f"[Service]\nExecStart=/opt/phil/current/{unit}\n"
        (folder / "units" / unit).write_text(text + ("[Install]\n" if unit == MAIN_UNIT else ""))
    return folder


def told(tmp_path) -> list[str]:
    log = tmp_path / "log"
    lines = log.read_text().splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return [line for line in lines if not line.startswith("show")]


def test_units_are_installed_enabled_started_and_taken_away(systemd, tmp_path):
    systemd.stop()
    assert told(tmp_path) == []  # there is no service yet
    one = release(tmp_path / "one", MAIN_UNIT, "phil-can.service")
    systemd.prepare(one)
    systemd.start(one)
    verbs = [f"{verb} {MAIN_UNIT}" for verb in ("enable", "reset-failed", "start")]
    assert told(tmp_path) == ["daemon-reload", *verbs]
    unit = (tmp_path / "etc" / MAIN_UNIT).read_text()
    assert f"ExecStart={tmp_path}/current/{MAIN_UNIT}" in unit
    systemd.watch(Limits(1.0, 0.1))
    assert systemd.describe() == "active standby"
    systemd.stop()
    assert told(tmp_path) == [f"stop {MAIN_UNIT}"]
    # The next release has no unit for the bus any more.
    systemd.prepare(release(tmp_path / "two", MAIN_UNIT))
    assert told(tmp_path)[0] == "disable --now phil-can.service"
    assert [p.name for p in (tmp_path / "etc").iterdir()] == [MAIN_UNIT]
    systemd.remove()
    assert told(tmp_path) == [f"stop {MAIN_UNIT}", f"disable --now {MAIN_UNIT}", "daemon-reload"]
    assert list((tmp_path / "etc").iterdir()) == []


@pytest.mark.parametrize(
    ("state", "match"),
    [
        (ACTIVE.replace("active", "failed", 1), "ended: success"),
        (ACTIVE.replace("NRestarts=0", "NRestarts=1"), "ended"),
        (ACTIVE.replace("=active", "=activating"), r"not healthy within 0\.2 s"),
    ],
)
def test_a_service_that_is_not_well_is_said(systemd, tmp_path, state, match):
    (tmp_path / "s").write_text(state)
    with pytest.raises(UnhealthyError, match=match):
        systemd.watch(Limits(0.2, 0.1))


def test_a_start_that_systemd_or_a_bundle_refuses_is_said(systemd, tmp_path):
    (tmp_path / "s").write_text("refuse")
    with pytest.raises(UnhealthyError, match=r"systemctl start .* failed"):
        systemd.start(release(tmp_path / "one", MAIN_UNIT))
    told(tmp_path)
    with pytest.raises(
        UnhealthyError, match=r"no phil-edge\.service"
    ):  # before anything is stopped
        systemd.try_release(release(tmp_path / "two", "phil-can.service"), "abc", Limits())
    assert told(tmp_path) == []


def test_a_damaged_list_of_units_names_no_file_outside(systemd, tmp_path):
    systemd.prepare(release(tmp_path / "one", MAIN_UNIT))
    outside = tmp_path / "outside"
    outside.touch()
    (tmp_path / "state/phil-units").write_bytes(b"\xff\xfe\n../outside\n\0\n" + MAIN_UNIT.encode())
    systemd.remove()
    assert outside.exists()
    assert list((tmp_path / "etc").iterdir()) == []


def try_release(systemd, tmp_path, said: str, state: str = ACTIVE) -> list[str]:
    (tmp_path / "log.said").write_text(said)
    (tmp_path / "s").write_text(state)
    systemd.try_release(release(tmp_path / "one", MAIN_UNIT), "abc", Limits(0.2, 0.1))
    return told(tmp_path)


def test_a_trial_runs_without_vehicle_and_network_and_is_taken_away(systemd, tmp_path):
    before, after = [f"stop {TRIAL_UNIT}", f"reset-failed {TRIAL_UNIT}"], []
    *after, run, left, gone = try_release(systemd, tmp_path, "loaded policy_id=abc\n")
    assert (after, [left, gone]) == (before, before)
    words = run.split()
    assert words[0] == "systemd-run"
    for name in ("PrivateNetwork=yes", "User=phil", "TimeoutStartSec=0.2", "NotifyAccess=main"):
        assert f"--property={name}" in words
    assert "--service-type=notify" in words
    assert {w.split("=")[1] for w in words if "WatchdogSec" in w or "RuntimeMaxSec" in w}
    assert run.endswith("--vehicle none --connect tcp/127.0.0.1:9 --log-level warning")


@pytest.mark.parametrize(
    ("said", "state", "match"),
    [
        ("policy_id=other\n", ACTIVE, "has loaded this policy"),
        ("ready\nerror: no such file\n", "refuse\nResult=exit-code", "exit-code: error: no such"),
        ("policy_id=abc\n", "ActiveState=failed\nResult=watchdog", "trial: watchdog"),
        ("policy_id=abc\n", "ActiveState=inactive\nResult=success", "trial: success"),
    ],
)
def test_a_trial_that_fails_says_why_and_is_taken_away(systemd, tmp_path, said, state, match):
    with pytest.raises(UnhealthyError, match=match):
        try_release(systemd, tmp_path, said, state)
    assert told(tmp_path)[-2:] == [f"stop {TRIAL_UNIT}", f"reset-failed {TRIAL_UNIT}"]


ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "deploy/container/Dockerfile").read_text()
INSTRUCTIONS = re.sub(r"(?m)^#.*\n|\\\n\s*", "", DOCKERFILE)
"""A line each, without comments."""


def only(word: str, text: str = INSTRUCTIONS.rpartition("FROM ")[2]) -> str:
    """The arguments of the only instruction of that name, in the last stage."""
    (found,) = re.findall(rf"(?m)^{word} (.*)$", text)
    return found


def test_it_runs_without_rights_and_asks_no_index():
    assert only("USER") == "10001:10001"
    assert not re.search(r"\b(pip|apt-get|curl|wget|ADD)\b", DOCKERFILE)
    copied = only("COPY", INSTRUCTIONS)
    assert copied == "--from=install /opt/phil /opt/phil"  # no bundle, so no private key


def test_no_private_key_is_left_and_its_folder_is_there_to_be_mounted(tmp_path):
    """What comes after the installer in the same layer, as its shell runs it."""
    secrets = tmp_path / "releases" / "1" / "tls"
    secrets.mkdir(parents=True)
    (secrets / "key.pem").write_text("private")
    (tmp_path / "current").symlink_to("releases/1")
    installer, _, after = only("RUN --mount=type=bind,\\S+", INSTRUCTIONS).partition(" && ")
    assert "install.pyz" in installer
    shell = ["sh", "-c", after.replace("/opt/phil", str(tmp_path))]
    done = subprocess.run(shell, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert list(secrets.iterdir()) == []


def test_the_runtime_is_the_first_process_as_a_unit_starts_it():
    """With the words and the folder of the systemd unit, which are proven on a board."""
    unit = (ROOT / "deploy/systemd/phil-edge.service").read_text().splitlines()
    assert f"ExecStart={' '.join(json.loads(only('ENTRYPOINT')))}" in unit
    assert f"WorkingDirectory={only('WORKDIR')}" in unit
