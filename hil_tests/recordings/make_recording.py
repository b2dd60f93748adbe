"""Drive and record anew what the next release is replayed against: ``make recording``.

Four left turns in lock-step, and one in real time whose simulator is stopped for half a second.
There the edge runtime must go into safe stop, and drive again after five states.
"""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from pathlib import Path

from edge_runtime.cli import run_cli
from edge_runtime.files import write_atomic
from edge_runtime.reach import free_endpoint
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, run_command

OUT = Path(__file__).with_name("left_turn.mcap")
TRUST = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
EPISODES = "4"
DRIVEN_BEFORE_S, STOPPED_S = 2.0, 0.5


def make_recording(_: object) -> int:
    """Make the recording and check it by replay; the old one stays where anything goes wrong."""
    endpoint = free_endpoint()
    simulate = ("bridge", "simulate", "--env", "left_turn", "--listen", endpoint)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "drive.mcap"
        record = ("bridge", "record", "--out", str(made), "--connect", endpoint)
        first = Process(*simulate, "--episodes", EPISODES)
        more = ("--wait-s", "30", "--linger-s", "30")
        with first, Process(*record, *more, ready="recording") as recorder:
            run = ("edge_runtime", "run", *TRUST, "--connect", endpoint)
            # It starts last, so that the drive begins once the recorder listens.
            with Process(*run, ready="ready", shown=True) as edge:
                first.succeed()
                edge.lines.clear()  # What follows is of the second one.
                with Process(*simulate, "--seed", EPISODES, "--clock", "realtime") as second:
                    edge.wait_for_line("now=drive")
                    time.sleep(DRIVEN_BEFORE_S)
                    second.send(signal.SIGSTOP)
                    time.sleep(STOPPED_S)
                    second.send(signal.SIGCONT)
                    second.succeed()
            recorder.send(signal.SIGTERM)
            recorder.succeed()
        run_command("bridge", "replay", str(made), *TRUST)
        write_atomic(OUT, made.read_bytes())
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(make_recording))
