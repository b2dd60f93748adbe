"""What systemd would be told, by a stand-in for systemctl that writes it down."""

from __future__ import annotations

import os
import sys

import pytest

from deploy.installer import systemctl
from deploy.installer.errors import UnhealthyError
from deploy.installer.health import Limits
from deploy.installer.systemctl import MAIN_UNIT, Systemd

FAKE = """\
#!{python}
import sys
with open({log!r}, "a") as log:
    log.write(" ".join(sys.argv[1:]) + "\\n")
if sys.argv[1] == "show":
    print(open({state!r}).read())
elif sys.argv[1] == "start" and "refuse" in open({state!r}).read():
    sys.exit("Job for phil-edge.service failed.")
"""
ACTIVE = "ActiveState=active\nSubState=running\nNRestarts=0\nResult=success\nStatusText=standby"


@pytest.fixture
def systemd(tmp_path, monkeypatch):
    """The service as units, with a folder of our own for them."""
    programs = tmp_path / "programs"
    programs.mkdir()
    names = {"python": sys.executable, "log": str(tmp_path / "log"), "state": str(tmp_path / "s")}
    (programs / "systemctl").write_text(FAKE.format(**names))
    (programs / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "s").write_text(ACTIVE)
    for folder in ("state", "etc"):
        (tmp_path / folder).mkdir()
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
    systemd.start(release(tmp_path / "one", MAIN_UNIT, "phil-can.service"))
    assert told(tmp_path) == [
        "daemon-reload",
        f"enable {MAIN_UNIT}",
        f"reset-failed {MAIN_UNIT}",
        f"start {MAIN_UNIT}",
    ]
    unit = (tmp_path / "etc" / MAIN_UNIT).read_text()
    assert f"ExecStart={tmp_path}/current/{MAIN_UNIT}" in unit
    systemd.watch(Limits(1.0, 0.1))
    assert systemd.describe() == "active standby"
    systemd.stop()
    assert told(tmp_path) == [f"stop {MAIN_UNIT}"]
    # The next release has no unit for the bus any more.
    systemd.start(release(tmp_path / "two", MAIN_UNIT))
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


def test_a_start_that_systemd_refuses_is_said(systemd, tmp_path):
    (tmp_path / "s").write_text("refuse")
    with pytest.raises(UnhealthyError, match=r"systemctl start .* failed"):
        systemd.start(release(tmp_path / "one", MAIN_UNIT))


def test_a_bundle_without_the_service_is_said(systemd, tmp_path):
    with pytest.raises(UnhealthyError, match=r"holds no phil-edge\.service"):
        systemd.start(release(tmp_path / "one", "phil-can.service"))


def test_systemd_is_not_taken_for_there_where_it_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(systemctl, "_BOOTED", tmp_path / "run")
    assert not systemctl.is_there()
    (tmp_path / "run").mkdir()
    assert systemctl.is_there()
