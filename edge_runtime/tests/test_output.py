"""What is printed: no text of a stranger that a terminal acts upon; one line for a full disk."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import pytest

from edge_runtime import log
from edge_runtime.errors import UserError
from edge_runtime.status_table import render_status

HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202e"


@pytest.mark.parametrize("log_format", log.FORMATS)
def test_a_log_line_holds_nothing_that_a_terminal_acts_upon(capsys, log_format):
    before = logging.getLogger("edge_runtime").handlers
    log.configure("info", log_format)
    log.event("info", "rejected", reason="malformed", detail=HOSTILE, name=HOSTILE.strip())
    log.close()
    logging.getLogger("edge_runtime").handlers = before
    line = capsys.readouterr().err
    assert line.endswith("\n")
    assert line[:-1].isprintable()
    assert "x1b" in line or "u001b" in line


def test_nor_does_an_error_or_a_status():
    assert str(UserError(f"no file {HOSTILE}")).isprintable()
    status = dict.fromkeys(("vehicle_id", "vehicle", "mode", "reason", "policy_id"), HOSTILE)
    counts = dict.fromkeys(("accepted", "superseded", "safe_stops", "deadline_misses"), 0)
    more = {"rejected": {HOSTILE: 1}, "inference_ms": {}, "needs_rearm": False, "uptime_s": 1.0}
    reply = {**status, **counts, **more, "manifest": {"scenario": HOSTILE}, "version": HOSTILE}
    table = render_status({**reply, "vehicle_fault": HOSTILE})
    assert all(line.isprintable() for line in table.splitlines())


def into_a_full_disk(*command, unbuffered=""):
    """Run with a stdout that takes nothing; ``unbuffered`` as PYTHONUNBUFFERED has it."""
    with open("/dev/full", "w") as full:
        return subprocess.run(
            [sys.executable, "-m", *command],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )


@pytest.mark.parametrize("package", ["edge_runtime", "deploy.installer", "deploy", "bridge"])
def test_a_full_disk_behind_stdout_is_one_line(package):
    done = into_a_full_disk(package, "--help")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "No space left on device" in done.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_command_that_cannot_print_its_result_ends_with_one_line(make_policy, unbuffered):
    flags = make_policy().flags
    done = into_a_full_disk("edge_runtime", "check", *flags[1:], unbuffered=unbuffered)
    assert done.returncode == 2
    assert done.stderr == "error: cannot write: No space left on device\n"
    run = ["edge_runtime", "run", *flags, "--connect", "tcp/127.0.0.1:1"]
    done = into_a_full_disk(*run, unbuffered=unbuffered)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr.endswith("error: cannot write: No space left on device\n")
    assert " ended " in done.stderr  # in order


def test_a_process_without_stdout_is_no_error():
    shell = f"{sys.executable} -m edge_runtime --version >&-"
    assert subprocess.run(shell, shell=True, stderr=subprocess.DEVNULL, check=False).returncode == 0
