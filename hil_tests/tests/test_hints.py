"""The commands that a command prints for another one, pasted into a shell elsewhere."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.__main__ import main as deploy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import rearm_command
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.drives import TOY, make_policy

PYTHON_FIRST = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


def said_after(process, text):
    process.wait_for_line(text)
    return next(line.partition(text)[2] for _, line in process.lines if text in line)


def test_every_address_of_ip_version_6_is_named_so_that_tls_finds_it():
    """A machine need not have that version: `tls/[::1]` is refused by Zenoh where it has."""
    assert "--connect tls/localhost:7447 " in rearm_command("tls/[::]:7447", "hunter01")


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_printed_commands_work_when_pasted(protocol, tmp_path):
    endpoint = free_endpoint(protocol).replace("127.0.0.1", "0.0.0.0")  # Nobody can reach that.
    certs, elsewhere, settings = (tmp_path / each for each in ("my certs", "elsewhere", "e.toml"))
    elsewhere.mkdir()
    settings.write_text("armed_at_start = false\n")
    simulate = ["bridge", "simulate", "--env", TOY, "--episodes", "99", "--listen", endpoint]
    if protocol == "tls":
        assert deploy(["certs", "--out", str(certs)]) == 0
        simulate += ["--tls", str(certs / "simulator-hunter01")]

    def shell(line):
        return subprocess.Popen(["bash", "-c", f"exec {line}"], cwd=elsewhere, env=PYTHON_FIRST)

    with Process(*simulate, "--wait-edge-s", "0") as alone:
        start = said_after(alone, "start one: ")
        assert alone.wait() == 2
    policy = f"'{make_policy(tmp_path)}' --allow-unsigned --vehicle mock --config '{settings}'"
    start, log = start.replace("POLICY.onnx", policy), tmp_path / "log"
    with Process(*simulate) as run, shell(f"{start} 2> '{log}'") as edge:
        try:
            rearm = said_after(run, "episode 0: the vehicle waits for a re-arm (not_armed): ")
            told = next(each for each in log.read_text().splitlines() if "waits_for_rearm" in each)
            assert rearm == ast.literal_eval(told.partition("command=")[2])
            # It is refused while a busy machine has no fresh states.
            wait_until(lambda: shell(rearm).wait() == 0, "the pasted command to re-arm it")
        finally:
            edge.terminate()
