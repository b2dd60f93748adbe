"""The release's regression test: the recorded drive, through today's policy and decision logic."""

from __future__ import annotations

import json

import pytest

from bridge.__main__ import main
from edge_runtime.cli import run_cli
from edge_runtime.tests.policies import write_policy
from hil_tests.recordings.make import LEFT_TURN, POLICY, PUBLIC_KEY

ROOT = LEFT_TURN.resolve().parents[2]


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def replay(out, *options):
    status = run_cli(main, ["replay", str(LEFT_TURN), "--out", str(out), *options])
    return status, json.loads(out.read_text())


def test_every_recorded_command_is_still_the_same(tmp_path):
    status, report = replay(tmp_path / "r.json", "--policy", POLICY, "--public-key", PUBLIC_KEY)
    assert report["recorded_policy_ids"] == [report["policy_id"]], "another policy: make recording"
    assert status == 0, report["first_differences"]
    assert report["compared"] > 200
    # Not only the driving: the simulator was stopped in the middle.
    assert report["by_recorded"]["safe_stop: no_fresh_state"]["compared"] >= 5
    assert report["different"] == report["dropped"] == 0


def test_another_policy_is_found_out(tmp_path):
    other = tmp_path / "other.onnx"
    write_policy(other, "mean")
    options = ("--policy", str(other), "--allow-unsigned")
    status, report = replay(tmp_path / "r.json", *options)
    assert status == 1
    assert report["by_recorded"]["drive"]["different"] > 100
    assert report["largest_difference"] > 0.1
