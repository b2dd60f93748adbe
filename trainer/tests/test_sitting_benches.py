"""What measures a sitting leaves no trainer behind, whatever goes wrong."""

import signal
import subprocess
import sys

import pytest

from edge_runtime.util import UserError
from trainer.benches import killed_sitting, pace
from trainer.benches.killed_sitting import KilledRun

SLEEPER = [sys.executable, "-c", "import time; time.sleep(600)"]
SOON_S = 30.0


def interrupted(*_arguments):
    raise KeyboardInterrupt


def test_the_pace_interrupted_ends_its_trainer(tmp_path, monkeypatch):
    started = []

    class Noted(subprocess.Popen):
        def __init__(self, _command, **options):
            super().__init__(SLEEPER, **options)
            started.append(self)

    monkeypatch.setattr(pace.subprocess, "Popen", Noted)
    monkeypatch.setattr(pace, "last_seen", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pace.drive(tmp_path, ["drive"], 1.0)
    with started[0] as process:
        assert process.wait(SOON_S) == -signal.SIGKILL


@pytest.mark.parametrize("how", ["kill", "end"])
def test_a_training_that_does_not_begin_to_drive_is_ended(tmp_path, monkeypatch, how):
    monkeypatch.setattr("trainer.benches.killed_sitting.PATIENCE_S", 0.0)
    run = KilledRun(tmp_path, 1.0, 4)
    run.seen.write_bytes(bytes(8))
    with subprocess.Popen(SLEEPER) as process:
        with pytest.raises(UserError, match="did not begin to drive"):
            run.kill(process, 0.0) if how == "kill" else run.end(process)
        assert process.wait(SOON_S) == -signal.SIGKILL


@pytest.mark.parametrize("bench", [pace, killed_sitting])
def test_a_file_that_cannot_be_written_is_told_before_the_minutes_of_driving(bench, monkeypatch):
    monkeypatch.setattr(bench, "measure", None)
    with pytest.raises(UserError, match="cannot write"):
        bench.main(["--out", "/dev/null/figures.json"])
