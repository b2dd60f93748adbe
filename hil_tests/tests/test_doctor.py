"""``python -m hil_tests doctor``: its checks find what is there, and what is not."""

import importlib
import os
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from hil_tests import doctor
from hil_tests.__main__ import main
from hil_tests.doctor import (
    CHECKS,
    Check,
    MissingError,
    basics_work,
    examine,
    lines,
    program_says,
    python_says,
    summary,
)
from trainer.util import find_chromium

ROOT = Path(__file__).parents[2]
BY_NAME = {check.name: check for check in CHECKS}


def found(probe, group="group"):
    return examine(Check(group, "thing", probe, "no driving", "buy one"))


def test_the_basics_work_where_the_tests_run(capsys):
    assert main(["doctor", "--only", "basics"]) == 0
    said = capsys.readouterr().out
    assert "  missing  " not in said
    assert said.endswith("The basics work. Nothing is missing.\n")


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


def test_a_missing_package_is_installed_whatever_was_to_be_tried():
    for probe in (
        partial(importlib.import_module, "no_such_package"),
        partial(python_says, "import no_such_package.part"),
    ):
        finding = found(probe)
        assert finding.detail == "Python finds no module no_such_package"
        assert finding.remedy == "make install"
    with pytest.raises(MissingError, match="ZeroDivisionError"):
        python_says("1 / 0")


def test_every_line_says_what_is_lost_and_how_to_get_it():
    assert all(check.without and check.remedy for check in CHECKS)
    assert len(BY_NAME) == len(CHECKS)


def test_the_browser_that_is_found_is_the_one_that_the_tests_use(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not examine(BY_NAME["Chromium"]).ok
    assert find_chromium() is None
    browser = tmp_path / "google-chrome-stable"
    browser.write_text("#!/bin/sh\necho Chrome 1\n")
    browser.chmod(0o755)
    assert examine(BY_NAME["Chromium"]).detail == "Chrome 1"
    assert find_chromium() == str(browser)


def test_a_port_is_tried():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        probe = partial(doctor.port, other.getsockname()[1])
        taken = found(probe)
        assert not taken.ok
        assert "Address already in use" in taken.detail
    assert found(probe).ok


def test_a_directory_that_takes_no_file_and_a_full_disk(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert examine(BY_NAME["disk"]).ok
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(doctor, "DISK_GB", 10**9)
    assert "are wanted" in examine(BY_NAME["disk"]).detail
    monkeypatch.chdir("/proc")
    assert not examine(BY_NAME["disk"]).ok


def test_packages_are_asked_for(monkeypatch, tmp_path):
    (tmp_path / "pyproject.toml").write_text(
        '[project]\ndependencies = ["numpy>=1", "no-such-thing!=1.2"]\n'
    )
    lock = tmp_path / "lock.txt"
    lock.write_text("numpy==0.0.1\nno-such-thing==1.0\n")
    monkeypatch.setattr(doctor, "ROOT", tmp_path)
    monkeypatch.setattr(doctor, "LOCK", lock)
    assert examine(BY_NAME["packages"]).detail == "not installed: no-such-thing"
    assert "(locked: 0.0.1)" in examine(BY_NAME["locked versions"]).detail


def test_an_old_python_is_missing_and_the_can_bus_carries_a_frame(monkeypatch):
    monkeypatch.setattr(doctor, "OLDEST", (99, 0))
    assert not examine(BY_NAME["Python"]).ok
    said = examine(BY_NAME["CAN over UDP"]).detail
    assert said == "a frame went through UDP multicast on loopback"


@pytest.mark.parametrize("display", [None, ":4711"])
def test_a_window_needs_a_display(monkeypatch, display):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    seen = examine(BY_NAME["window"])
    assert not seen.ok
    assert (display or "neither DISPLAY") in seen.detail


def test_programs_are_run(monkeypatch, tmp_path):
    tool = tmp_path / "tool"
    tool.write_text("#!/bin/sh\necho tool 1.2\necho second line\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert found(partial(program_says, "tool")).detail == "tool 1.2"
    tool.write_text("#!/bin/sh\necho broken >&2\nexit 3\n")
    assert found(partial(program_says, "tool")).detail == "tool: broken"
    assert found(partial(program_says, "toool")).detail == "toool is not installed"


def test_what_goes_wrong_in_a_check_is_its_finding():
    def probe():
        raise ImportError("libsomething.so:\n no such file")

    broken = found(probe, "basics")
    assert lines(broken).splitlines() == [
        "  missing  thing: ImportError: libsomething.so: no such file",
        "           without it: no driving",
        "           get it: buy one",
    ]
    assert not basics_work([broken])
    assert summary([broken]) == "The basics do not work here: thing."
    extra, basic = found(probe), found(lambda: "there", "basics")
    assert basics_work([extra, basic])
    assert summary([extra, basic]) == "The basics work. Missing besides: thing."
    assert summary([extra]) == "Missing: thing."
    assert summary([basic]) == "The basics work. Nothing is missing."
