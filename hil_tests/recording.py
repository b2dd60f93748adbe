"""``python -m hil_tests recording``: drive, record, check by replay, and keep.

The recording, which the next release is replayed against, holds four left turns in lock-step and
one in real time whose simulator is stopped for half a second: the edge runtime must go into safe
stop, and drive again after five states.
"""

from __future__ import annotations

import argparse
import signal
import tempfile
import time
from pathlib import Path

from bridge.recording import Recording
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError, read_bytes
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, run_command, wait_until

LEFT_TURN = Path("hil_tests/recordings/left_turn.mcap")
TRUST = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
EPISODES = 4
MAX_BYTES = 300_000
DRIVEN_BEFORE_S = 2.0
STOPPED_S = 0.5
PATIENCE_S = 60.0
EXAMPLE = examples("python -m hil_tests recording --out runs/left_turn.mcap")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="F.mcap", default=str(LEFT_TURN), help="where it is kept")


def run(arguments: argparse.Namespace) -> int:
    """Make the recording anew; the old one stays where anything goes wrong."""
    out = Path(arguments.out)
    check_writable(out)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "drive.mcap"
        _record(made)
        run_command("bridge", "replay", str(made), *TRUST)
        data = read_bytes(made, "recording")
        if len(data) > MAX_BYTES:
            raise UserError(f"the recording has {len(data)} bytes, more than {MAX_BYTES}")
        write_atomic(out, data)
    print(f"wrote {out}: {len(data)} bytes")
    return 0


def _record(out: Path) -> None:
    """The runtime starts last, so that the drive begins once the recorder listens."""
    endpoint = free_endpoint()
    simulate = ("bridge", "simulate", "--env", "left_turn", "--listen", endpoint)
    record = ("bridge", "record", "--out", str(out), "--connect", endpoint)
    first = Process(*simulate, "--episodes", str(EPISODES))
    wait = ("--wait-s", "30", "--linger-s", "30")
    with first, Process(*record, *wait) as recorder:
        _wait_for_simulators(out, 1)
        run = ("edge_runtime", "run", *TRUST, "--connect", endpoint)
        with Process(*run, ready="ready", shown=True):
            first.succeed(PATIENCE_S)
            realtime = ("--seed", str(EPISODES), "--clock", "realtime")
            with Process(*simulate, *realtime) as second:
                _wait_for_simulators(out, 2)
                time.sleep(DRIVEN_BEFORE_S)
                second.send(signal.SIGSTOP)
                time.sleep(STOPPED_S)
                second.send(signal.SIGCONT)
                second.succeed(PATIENCE_S)
        recorder.send(signal.SIGTERM)
        recorder.succeed(PATIENCE_S)


def _wait_for_simulators(out: Path, count: int) -> None:
    """Until so many simulators have come in all."""

    def came() -> bool:
        return out.exists() and count <= sum(
            stored.channel.topic.endswith("/simulator") and b"true" in stored.message.data
            for stored in Recording(out).messages()
        )

    wait_until(came, "the simulator", PATIENCE_S)
