"""The commands that a command prints for another one, pasted into a shell elsewhere."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.__main__ import main as deploy
from edge_runtime.reach import free_endpoint
from hil_tests.processes import PATIENCE_S, Process
from hil_tests.testing.drives import TOY, make_policy

PYTHON_FIRST = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_printed_commands_work_when_pasted(protocol, host, tmp_path):
    endpoint = free_endpoint(protocol).replace("127.0.0.1", host)
    certs, elsewhere = tmp_path / "my certs", tmp_path / "elsewhere"
    elsewhere.mkdir()
    simulate = ["bridge", "simulate", "--env", TOY, "--episodes", "3", "--listen", endpoint]
    if protocol == "tls":
        assert deploy(["certs", "--out", str(certs)]) == 0
        simulate += ["--tls", str(certs / "simulator-hunter01")]

    def shell(line):
        pipe = subprocess.PIPE
        return subprocess.Popen(
            ["bash", "-c", f"exec {line}"],
            cwd=elsewhere,
            env=PYTHON_FIRST,
            text=True,
            stderr=pipe,
            stdout=pipe,
        )

    def rearms(line):
        with shell(line) as rearm:
            assert rearm.wait(PATIENCE_S) == 0, rearm.stderr.read()

    with Process(*simulate, "--wait-edge-s", "0") as alone:
        assert alone.wait() == 2
    start = alone.errors.partition("start one: ")[2].strip()
    policy = f"'{make_policy(tmp_path)}' --allow-unsigned --vehicle mock"
    log = tmp_path / "log"
    with (
        Process(*simulate) as run,
        shell(f"{start.replace('POLICY.onnx', policy)} 2> '{log}'") as edge,
    ):
        try:
            run.wait_for_line("episode 1: the vehicle waits for a re-arm")
            said = next(line for _, line in run.lines if "episode 1" in line)
            rearms(said.partition("): ")[2])
            run.wait_for_line("episode 2: the vehicle waits for a re-arm")
            told = re.findall("waits_for_rearm after=episode command=(.*)", log.read_text())
            rearms(ast.literal_eval(told[-1]))
            assert run.wait() == 0, run.errors
        finally:
            edge.terminate()
