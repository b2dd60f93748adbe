import os
import signal
import subprocess
import sys

import pytest

from edge_runtime.util import UserError
from hil_tests.processes import CommandTimeoutError, Process, wait_until

SERVER = ("http.server", "0", "--bind", "127.0.0.1")


def test_a_process_that_does_not_end_times_out_and_is_ended():
    with pytest.raises(CommandTimeoutError), Process(*SERVER) as process:
        process.wait(0.1)
    assert process.has_ended


def test_a_process_has_crashed_where_nobody_ended_it():
    with Process("json.tool", "nowhere") as failed, Process(*SERVER) as ended:
        wait_until(lambda: failed.has_ended, "its end")
        ended.end()
        assert (failed.crashed(), ended.crashed()) == (True, False)


def test_a_process_that_ends_before_it_is_ready_says_why(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        Process("edge_runtime", "run", "--policy", str(tmp_path / "none.onnx"), ready="ready")


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
        "from hil_tests.processes import run_command; run_command('child')"
    )
    line = [sys.executable, "-c", code]
    parent = subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True)
    wait_until((tmp_path / "ready").exists, "the child")
    os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    assert parent.wait(30) != 0
    assert (tmp_path / "kept").exists()
