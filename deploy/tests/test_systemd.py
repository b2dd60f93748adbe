import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy.installer.systemd import (
    CAN_UNIT,
    MAIN_UNIT,
    TRIAL_UNIT,
    HealthLimits,
    Systemd,
    UnhealthyError,
)
from edge_runtime.policy import MAX_POLICY_MIB

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
    program = tmp_path / "current/bin/phil-edge"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    paths = [tmp_path / name for name in MAX_EXPOSURE]
    for path in paths:
        path.write_text((UNITS / path.name).read_text().replace("/opt/phil", str(tmp_path)))
    done = analyze("verify", "--man=no", *map(str, paths))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


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
    assert int(unit["MemoryMax"].removesuffix("M")) >= 5 * MAX_POLICY_MIB  # loaded with weights
    tries_s = float(unit["RestartSec"]) * float(unit["StartLimitBurst"])
    assert tries_s < float(unit["StartLimitIntervalSec"])  # or the limit would never be reached
    assert not {"Requires", "BindsTo", "Requisite"} & set(unit)  # the bus is no condition
    assert "bitrate 500000" in (UNITS / CAN_UNIT).read_text()


ACTIVE = "ActiveState=active\nSubState=running\nNRestarts=0\nResult=success\nStatusText=standby"
LIMITS = HealthLimits(1.0, 0.1)
TRIAL_ENDS = [["systemctl", verb, TRIAL_UNIT] for verb in ("stop", "reset-failed")]


class Programs:
    """In the place of systemd's programs: notes what they are told."""

    def __init__(self) -> None:
        self.state, self.log = ACTIVE, b""
        self.told: list[list[str]] = []

    def run(self, command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        for word in command:
            if "StandardError=file:" in word:
                Path(word.partition("=file:")[2]).write_bytes(self.log)
        if command[1] == "show":
            return subprocess.CompletedProcess(command, 0, self.state, "")
        self.told.append(command)
        starts = command[0] == "systemd-run" or command[1] == "start"
        refuses = starts and "refuse" in self.state
        return subprocess.CompletedProcess(command, refuses, "", "Job failed." * refuses)


@pytest.fixture
def programs(monkeypatch):
    programs = Programs()
    monkeypatch.setattr("deploy.installer.systemd.subprocess", programs)
    return programs


def test_units_are_installed_enabled_started_and_taken_away(programs, tmp_path):
    units, release = tmp_path / "etc", tmp_path / "one"
    units.mkdir()
    (release / "units").mkdir(parents=True)
    for unit in MAX_EXPOSURE:
        (release / "units" / unit).write_text("[Service]\nExecStart=/opt/phil/one\n")
    service = Systemd(tmp_path, units)
    service.stop()
    assert programs.told == []  # there is no service yet
    service.prepare(release)
    service.start(LIMITS)
    assert f"ExecStart={tmp_path}/one" in (units / MAIN_UNIT).read_text()
    assert service.describe() == "active standby"
    service.remove()
    assert [words[1:] for words in programs.told] == [
        ["daemon-reload"], ["enable", MAIN_UNIT, CAN_UNIT], ["reset-failed", MAIN_UNIT],
        ["start", MAIN_UNIT], ["stop", MAIN_UNIT], ["disable", "--now", MAIN_UNIT, CAN_UNIT],
        ["daemon-reload"],
    ]  # fmt: skip
    assert list(units.iterdir()) == []


@pytest.mark.parametrize(
    "state",
    [ACTIVE.replace("=active", "=failed"), ACTIVE.replace("NRestarts=0", "NRestarts=1"), "refuse"],
)
def test_a_service_that_does_not_get_well_is_unhealthy(programs, tmp_path, state):
    programs.state = state
    with pytest.raises(UnhealthyError):
        Systemd(tmp_path).start(LIMITS)


def test_a_trial_runs_without_vehicle_and_network_and_is_taken_away(programs, tmp_path):
    programs.log = b"loaded policy_id=abc\n"
    Systemd(tmp_path).try_release(tmp_path, "abc", LIMITS)
    assert programs.told[:2] == programs.told[3:] == TRIAL_ENDS
    words = programs.told[2]
    assert words[0] == "systemd-run"
    for name in ("PrivateNetwork=yes", "User=phil", "TimeoutStartSec=1.0", "NotifyAccess=main"):
        assert f"--property={name}" in words
    assert "--service-type=notify" in words
    assert len([w for w in words if "WatchdogSec" in w or "RuntimeMaxSec" in w]) == 2
    assert words[-6:-2] == ["--vehicle", "none", "--connect", "tcp/127.0.0.1:9"]


@pytest.mark.parametrize(
    ("said", "state", "why"),
    [
        (b"policy_id=other\n", ACTIVE, "policy"),
        (b"ready\nerror: no such file\n", "refuse\nResult=exit-code", "exit-code: error: no such"),
        (b"policy_id=abc\n", "ActiveState=failed\nResult=watchdog", "watchdog"),
    ],
)
def test_a_trial_that_fails_says_why_and_is_taken_away(programs, tmp_path, said, state, why):
    programs.log, programs.state = said, state
    with pytest.raises(UnhealthyError, match=why):
        Systemd(tmp_path).try_release(tmp_path, "abc", LIMITS)
    assert programs.told[-2:] == TRIAL_ENDS


INSTRUCTIONS = re.sub(r"(?m)^#.*\n|\\\n\s*", "", (ROOT / "deploy/container/Dockerfile").read_text())
"""Of the Dockerfile: a line each, without comments."""


def only(word: str, text: str = INSTRUCTIONS.rpartition("FROM ")[2]) -> str:
    """The arguments of the only instruction of that name, in the last stage."""
    (found,) = re.findall(rf"(?m)^{word} (.*)$", text)
    return found


def test_the_image_runs_as_the_unit_with_no_rights_no_index_and_no_private_key(tmp_path):
    unit = settings(MAIN_UNIT)
    assert unit["ExecStart"] == " ".join(json.loads(only("ENTRYPOINT")))
    assert unit["WorkingDirectory"] == only("WORKDIR")
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
