"""The unit files: systemd takes them as they are, and what they promise stands in them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = Path(__file__).parents[1] / "systemd"
NAMES = ("phil-edge.service", "phil-can.service")
MAX_EXPOSURE = {"phil-edge.service": 20, "phil-can.service": 25}
"""Tenths; see `systemd-analyze security`, where 100 is a service without any protection."""


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not there (Debian's package systemd)")
    return subprocess.run(
        ["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60, check=False
    )


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


def test_systemd_would_say_what_is_wrong(units):
    """What makes the test above mean something."""
    unit = units / NAMES[0]
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchDogSec="))
    assert "WatchDogSec" in analyze("verify", "--man=no", str(unit)).stderr


@pytest.mark.parametrize("name", NAMES)
def test_exposure(name):
    """Exit status 1 above the threshold."""
    limit = f"--threshold={MAX_EXPOSURE[name]}"
    options = ("security", "--offline=true", "--no-pager")
    if "--offline" not in analyze("--help").stdout:
        pytest.skip("systemd-analyze security --offline came with systemd 250")
    done = analyze(*options, limit, str(UNITS / name))
    assert done.returncode == 0, done.stdout
    assert analyze(*options, "--threshold=1", str(UNITS / name)).returncode == 1


def settings(name: str) -> dict[str, list[str]]:
    """Every value of a key in a unit, in its order."""
    found: dict[str, list[str]] = {}
    for line in (UNITS / name).read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def test_the_runtime_has_a_watchdog_limits_no_rights_and_nothing_to_write_to():
    unit = settings("phil-edge.service")
    assert unit["Type"] == ["notify"]
    assert float(unit["WatchdogSec"][0]) <= 3
    assert unit["Restart"] == ["on-failure"]
    pause_s, starts, in_s = (
        float(unit[k][0]) for k in ("RestartSec", "StartLimitBurst", "StartLimitIntervalSec")
    )
    assert pause_s * starts < in_s  # or the limit would never be reached
    assert unit["User"] == ["phil"]
    assert unit["CapabilityBoundingSet"] == unit["AmbientCapabilities"] == [""]
    assert unit["ProtectSystem"] == ["strict"]
    assert "ReadWritePaths" not in unit
    assert "StateDirectory" not in unit
    assert unit["CPUAffinity"]
    assert "phil-can.service" in unit["After"][0]
    assert "network-online.target" in unit["After"][0]


def test_the_bus_has_the_hunters_rate_and_is_no_condition_of_the_runtime():
    unit, runtime = settings("phil-can.service"), settings("phil-edge.service")
    assert any("bitrate 500000" in each for each in unit["ExecStart"])
    assert "phil-can.service" in runtime["Wants"][0]
    assert not {"Requires", "BindsTo", "Requisite"} & set(runtime)
    assert unit["CapabilityBoundingSet"] == ["CAP_NET_ADMIN CAP_SYS_MODULE"]
