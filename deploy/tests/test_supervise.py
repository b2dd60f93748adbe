"""The supervisor without systemd: its own end is an orderly stop of the runtime."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from deploy.installer.layout import Layout

_RUNTIME = """#!/bin/sh
trap 'touch "{told}"; exit 0' TERM
touch "{ready}"
while :; do sleep 0.05; done
"""


ENDS = (signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM, signal.SIGXCPU, signal.SIGRTMIN)


@pytest.mark.parametrize("number", ENDS)
def test_whatever_ends_it_the_runtime_is_stopped_and_not_killed(tmp_path, number):
    layout = Layout(str(tmp_path))
    told, ready = tmp_path / "told", tmp_path / "ready"
    program = layout.release("1") / "bin" / "phil-edge"
    program.parent.mkdir(parents=True)
    layout.state.mkdir()
    program.write_text(_RUNTIME.format(told=told, ready=ready))
    program.chmod(0o755)
    layout.link("current", "1")
    command = [sys.executable, "-m", "deploy.installer", "supervise", "--root", str(tmp_path)]
    ours = signal.signal(number, signal.SIG_DFL)  # under nohup SIGHUP would be ignored
    try:
        run = subprocess.Popen(command)
    finally:
        signal.signal(number, ours)
    with run:
        while not ready.exists():
            assert run.poll() is None
        run.send_signal(number)
        assert run.wait(timeout=20) == 0
    assert told.exists()
