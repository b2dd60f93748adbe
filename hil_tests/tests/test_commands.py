"""A command run in front, as a person would type it."""

import os
import signal
import subprocess
import sys
import time

CHILD = """
import signal, sys, time
from pathlib import Path

def keep(number, frame):
    time.sleep(1.0)
    Path("kept").touch()
    sys.exit(130)

signal.signal(signal.SIGINT, keep)
Path("ready").touch()
time.sleep(60)
"""


def test_what_an_interrupted_command_keeps_is_waited_for(tmp_path):
    (tmp_path / "child.py").write_text(CHILD)
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "from hil_tests.commands import run_command; run_command('child')"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    end_s = time.monotonic() + 30.0
    while not (tmp_path / "ready").exists() and time.monotonic() < end_s:
        time.sleep(0.02)
    os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    assert parent.wait(30) != 0
    assert (tmp_path / "kept").exists()
