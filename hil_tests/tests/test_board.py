"""Boards that are not there (marker ``board``), and the parts of them that need no minutes."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from edge_runtime.util import UserError
from hil_tests.__main__ import main
from hil_tests.board import command
from hil_tests.board.place import Place

ROOT = Path(__file__).parents[2]
NEEDS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="namespaces need root")


@NEEDS_ROOT
def test_a_place_has_no_network_and_leaves_nothing(tmp_path):
    with Place() as place:
        listed = place.run("ls", "/sys/class/net", "/proc/1/cmdline")
        devices = subprocess.run(
            [*place.beside(), "ip", "-oneline", "link"], capture_output=True, text=True, check=True
        ).stdout.splitlines()
        assert len(devices) == 1, devices
        assert ": lo:" in devices[0]
        assert "UP" in devices[0]
        assert listed.stdout
        # What is started inside and left behind, as an installer leaves its supervisor.
        started = place.run("sh", "-c", "sleep 1000 > /dev/null 2>&1 & echo $!")
        assert started.returncode == 0
        shown = place.run("pgrep", "-x", "sleep")
        assert started.stdout.strip() in shown.stdout.split()
        holder = Path(f"/proc/{place.inside()[2]}")
        mounts = (holder / "mountinfo").read_text()
        assert holder.exists()
    assert not holder.exists() or (holder / "cmdline").read_bytes() == b""  # or a zombie
    assert mounts.count(" /proc ") > Path("/proc/self/mountinfo").read_text().count(" /proc ")


@pytest.mark.parametrize("board", command.BOARDS)
def test_what_is_missing_is_said(board, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(UserError, match=f"no {board} here: .* needs root"):
        main(["board", "--boards", board, "--out", str(tmp_path / "r.json")])


@pytest.mark.board
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("board", command.BOARDS)
def test_a_bundle_is_installed_without_a_network_and_drives(board):
    if reason := command.why_not(board):
        pytest.skip(reason)
    report = command.prove(board, ROOT / "build" / "board", ROOT / "build" / "wheels")
    python, machine = ("3.9.", "aarch64") if board == "aarch64" else ("3.8.", "x86_64")
    assert report["python"].startswith(python)
    assert report["machine"] == machine
    assert report["status"]["whole"] == "yes"
    assert report["status"]["service"].startswith("active")
    assert report["episode"]["policy_id"] == report["status"]["policy_id"]
    assert report["episode"]["answered_states"] > 0
    assert set(report["episode"]["rejected"]) <= {"stale"}  # a busy machine's
    assert not report["left_after_uninstall"]
    if board == "systemd":
        assert report["written"] == []
        assert report["process"]["Uid"].split()[0] != "0"
        assert int(report["process"]["CapBnd"], 16) == 0
        assert report["process"]["NoNewPrivs"] == "1"
        assert report["process"]["Seccomp"] == "2"
        assert report["can_unit"] == "exec-condition"  # no bus here: skipped, not failed
