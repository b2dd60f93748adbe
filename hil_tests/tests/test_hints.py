"""The commands that a command prints for another one, pasted into a shell elsewhere."""

import ast
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.__main__ import main as deploy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import rearm_command
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.commands import refusal
from hil_tests.tests.shared.drives import TOY, make_policy

PYTHON_FIRST = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


def said_after(process, text):
    process.wait_for_line(text)
    return next(line.partition(text)[2] for _, line in process.lines if text in line)


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7449", "tls/[::]:7449", "tcp/10.0.0.2:7449"])
def test_a_printed_address_is_one_that_the_reader_can_reach(endpoint):
    words = rearm_command(endpoint, "car-a")
    reached = endpoint.replace("0.0.0.0", "127.0.0.1").replace("[::]", "localhost")
    assert shlex.split(words) == [
        "python", "-m", "edge_runtime", "rearm", "--connect", reached, "--vehicle-id", "car-a",
    ]  # fmt: skip


def test_printed_commands_work_when_pasted(tmp_path, capsys):
    endpoint = free_endpoint("tls").replace("127.0.0.1", "0.0.0.0")  # Nobody can reach that.
    certs, elsewhere, settings = (tmp_path / each for each in ("my certs", "elsewhere", "e.toml"))
    elsewhere.mkdir()
    settings.write_text("armed_at_start = false\n")
    assert deploy(["certs", "--out", str(certs)]) == 0
    simulate = ["simulate", "--env", TOY, "--episodes", "99", "--listen", endpoint]
    simulate += ["--tls", str(certs / "simulator-hunter01")]

    def shell(line):
        return subprocess.Popen(["bash", "-c", f"exec {line}"], cwd=elsewhere, env=PYTHON_FIRST)

    capsys.readouterr()
    start = refusal(capsys, *simulate, "--wait-edge-s", "0", package="bridge")
    start = start.strip().partition("start one: ")[2]
    policy = f"'{make_policy(tmp_path)}' --allow-unsigned --vehicle mock --config '{settings}'"
    start, log = start.replace("POLICY.onnx", policy), tmp_path / "log"
    with Process("bridge", *simulate) as run, shell(f"{start} 2> '{log}'") as edge:
        try:
            rearm = said_after(run, "episode 0: the vehicle waits for a re-arm (not_armed): ")
            told = next(each for each in log.read_text().splitlines() if "waits_for_rearm" in each)
            assert rearm == ast.literal_eval(told.partition("command=")[2])
            # It is refused while a busy machine has no fresh states.
            wait_until(lambda: shell(rearm).wait() == 0, "the pasted command to re-arm it")
        finally:
            edge.terminate()
