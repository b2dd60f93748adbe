import importlib
import json
from unittest.mock import MagicMock

import pytest

from edge_runtime.cli import run_cli
from hil_tests import demo
from hil_tests.__main__ import main
from hil_tests.processes import run_command

SMALL = {
    "HUMAN": ("--episodes", 5, "--max-minutes", 0.001, "--refining-updates", 10),
    "TRAINING": ("--steps", 10, "--max-minutes", 1),
    "SETTINGS": ("batch_size=8", "evaluation_runs=1"), "RUNS": 1, "RECORDED_RUNS": 1,
}  # fmt: skip


@pytest.mark.timeout(400)
def test_the_demo_makes_all_it_promises_and_then_uses_what_is_kept(tmp_path, monkeypatch, capsys):
    def run_here(package, *words):
        """Run a command in this process, which has loaded what takes seconds."""
        program = importlib.import_module(f"{package}.__main__")
        assert run_cli(program.main, [str(word) for word in words]) == 0

    for name, value in SMALL.items():
        monkeypatch.setattr(demo, name, value)

    def run(*words):  # The one in real time waits for whoever records it.
        (run_command if "realtime" in words else run_here)(*words)

    monkeypatch.setattr(demo, "run_command", run)
    words = ["demo", "--out", str(tmp_path / "demo")]
    first = main(words)
    # A policy of sixty steps may well drive badly (status 1); anything else is a fault.
    assert first in (0, 1)
    shown = capsys.readouterr().out
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    assert made >= {
        "left_turn.onnx", "left_turn.onnx.sig", "drive.rrd",
        "in_process.json", "wire.json", "wire_latency.json", "keys", "run", "human",
    }  # fmt: skip
    names = ("in_process", "wire", "wire_latency")
    reports = [json.loads((tmp_path / "demo" / f"{name}.json").read_text()) for name in names]
    assert len({report["policy_id"] for report in reports}) == 1
    assert reports[2]["latency_ms"]["p50"] > 80
    for text in ("in process", "over Zenoh", "each way", "safe stops"):
        assert text in shown
    policy = (tmp_path / "demo" / "left_turn.onnx").read_bytes()
    # What the second one does with its policy is what the first one did: only its commands count.
    commands = []
    monkeypatch.setattr(demo, "run_command", lambda *words: commands.append(words[:2]))
    for process in ("Process", "operator"):
        monkeypatch.setattr(demo, process, MagicMock())
    assert main(words) == first
    assert "Using the policy" in capsys.readouterr().out
    assert commands == [("trainer", "evaluate"), *[("bridge", "simulate")] * 3]
    assert (tmp_path / "demo" / "left_turn.onnx").read_bytes() == policy
