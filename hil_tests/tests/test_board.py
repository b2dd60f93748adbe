"""Boards that are not there (marker ``board``), and the parts of them that need no minutes."""

from __future__ import annotations

import os

import pytest

from edge_runtime.util import UserError
from hil_tests import board as boards
from hil_tests.__main__ import main
from hil_tests.board import BOARDS, FAULTS, prove, why_not

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
