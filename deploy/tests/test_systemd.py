import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy.installer import systemd
from deploy.installer.systemd import CAN_UNIT, MAIN_UNIT, TRIAL_UNIT, Systemd, UnhealthyError
from edge_runtime.policy import MAX_POLICY_MIB

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "deploy/systemd"
MAX_EXPOSURE = {MAIN_UNIT: 20, CAN_UNIT: 25}
"""Tenths; see `systemd-analyze security`, where 100 is a service without any protection."""


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="it needs systemd-analyze")
@pytest.mark.parametrize("name", MAX_EXPOSURE)
def test_systemd_takes_every_line_and_finds_little_exposed(tmp_path, name):
    program = tmp_path / "current/bin/phil-edge"
    program.parent.mkdir(parents=True)
    program.touch(0o755)
    for unit in MAX_EXPOSURE:  # They name each other.
        text = (UNITS / unit).read_text().replace("/opt/phil", str(tmp_path))
        (tmp_path / unit).write_text(text)
    limit = f"--threshold={MAX_EXPOSURE[name]}"
    for words in (["verify", "--man=no"], ["security", "--offline=true", "--no-pager", limit]):
        line = ["systemd-analyze", *words, str(tmp_path / name)]
        done = subprocess.run(line, capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr) == (0, ""), done.stdout


def test_the_runtime_is_restarted_when_it_is_silent_and_has_room_for_a_policy():
    text = (UNITS / MAIN_UNIT).read_text()
    assert {"Type=notify", "User=phil", "WatchdogSec=3"} <= set(text.splitlines())
    (memory_mib,) = re.findall(r"(?m)^MemoryMax=(\d+)M$", text)
    assert int(memory_mib) >= 5 * MAX_POLICY_MIB  # loaded with weights


ACTIVE = "ActiveState=active\nNRestarts=0\nResult=success\n"
STOP_TRIAL = ["systemctl", "stop", TRIAL_UNIT]


class Programs:
    """In the place of systemd's programs: notes what they are told."""

    def __init__(self) -> None:
        self.state = ACTIVE
        self.told: list[list[str]] = []

    def run(self, command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        for word in command:
            if "StandardError=file:" in word:
                Path(word.partition("=file:")[2]).write_text("ready\nerror: no such file\n")
        if command[1] == "show":
            return subprocess.CompletedProcess(command, 0, self.state, "")
        self.told.append(command)
        refuses = "refuse" in self.state and (command[0] == "systemd-run" or command[1] == "start")
        return subprocess.CompletedProcess(command, refuses, "active\n", "Job failed." * refuses)


@pytest.fixture
def programs(monkeypatch, tmp_path):
    programs = Programs()
    monkeypatch.setattr(systemd, "subprocess", programs)
    monkeypatch.setattr(systemd, "SETTLE_S", 0.0)
    monkeypatch.setattr(systemd, "UNIT_FOLDER", tmp_path / "etc")
    monkeypatch.setattr(Systemd, "group", lambda self: os.getgid())
    return programs


def test_units_are_installed_enabled_started_and_taken_away(programs, tmp_path):
    units, release = tmp_path / "etc", tmp_path / "one/units"
    release.mkdir(parents=True)
    for unit in MAX_EXPOSURE:
        (release / unit).write_text("[Service]\nExecStart=/opt/phil/one\n")
    service = Systemd(tmp_path)
    service.stop()  # there is none yet
    service.prepare(release.parent)
    service.start()
    assert f"ExecStart={tmp_path}/one" in (units / MAIN_UNIT).read_text()
    assert service.describe() == "active"
    service.remove()
    assert [words[1:] for words in programs.told] == [
        ["daemon-reload"], ["enable", MAIN_UNIT, CAN_UNIT], ["reset-failed", MAIN_UNIT],
        ["start", MAIN_UNIT], ["is-active", MAIN_UNIT],
        ["disable", "--now", MAIN_UNIT, CAN_UNIT], ["daemon-reload"],
    ]  # fmt: skip
    assert list(units.iterdir()) == []


FAILED, RESTARTED = ACTIVE.replace("=active", "=failed"), ACTIVE.replace("s=0", "s=1")


@pytest.mark.parametrize("state", [FAILED, RESTARTED, "refuse"])
def test_a_service_or_trial_that_does_not_get_well_is_unhealthy(programs, tmp_path, state):
    programs.state = state
    with pytest.raises(UnhealthyError):
        Systemd(tmp_path).start()
    with pytest.raises(UnhealthyError, match="error: no such file"):
        Systemd(tmp_path).try_release(tmp_path)
    assert programs.told[-1] == STOP_TRIAL


def test_a_trial_runs_without_vehicle_and_network_and_is_taken_away(programs, tmp_path):
    (tmp_path / "tls").mkdir()
    (tmp_path / "tls/key.pem").touch(0o600)
    Systemd(tmp_path).try_release(tmp_path)
    assert (tmp_path / "tls/key.pem").stat().st_mode & 0o777 == 0o640  # of the service's group
    first, words, last = programs.told
    assert first == last == STOP_TRIAL
    assert words[0] == "systemd-run"
    for name in ("PrivateNetwork=yes", "User=phil", "TimeoutStartSec=30.0", "WatchdogSec=0.0"):
        assert f"--property={name}" in words
    assert "--service-type=notify" in words
    assert words[-6:-2] == ["--vehicle", "none", "--connect", "tls/127.0.0.1:9"]
