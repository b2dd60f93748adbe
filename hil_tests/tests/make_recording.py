"""Make the recording that the tests replay anew: ``make recording``.

It holds four left turns in lock-step, and one in real time with an outage of half a second, in
which the edge runtime must go into safe stop, and drive again after five states.
"""

from __future__ import annotations

import signal
import sys
import tempfile
from pathlib import Path

from edge_runtime.cli import run_cli
from edge_runtime.files import write_atomic
from edge_runtime.reach import free_endpoint
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, run_command

OUT = Path(__file__).parents[1] / "recordings/left_turn.mcap"
TRUST = ("--policy", POLICY, "--public-key", PUBLIC_KEY)
EPISODES = 4
LAST = ("--seed", EPISODES, "--clock", "realtime", "--latency", "outage=0.5s@2s")


def make_recording(_: object) -> int:
    """Make the recording and check it by replay; keep the old one if anything fails."""
    endpoint = free_endpoint()
    simulate = ("bridge", "simulate", "--env", "left_turn", "--listen", endpoint)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "drive.mcap"
        record = ("record", "--out", made, "--connect", endpoint, "--linger-s", 30, "--wait-s", 30)
        first = Process(*simulate, "--episodes", EPISODES)
        with first, Process("bridge", *record, ready="recording") as recorder:
            run = ("edge_runtime", "run", *TRUST, "--connect", endpoint)
            # It starts last, so that the drive begins once the recorder listens.
            with Process(*run, ready="ready", shown=True):
                first.succeed()
                run_command(*simulate, *LAST)
            recorder.send(signal.SIGTERM)
            recorder.succeed()
        run_command("bridge", "replay", made, *TRUST)
        write_atomic(OUT, made.read_bytes())
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(make_recording))
