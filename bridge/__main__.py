"""``python -m bridge``: the simulator's side of the wire."""

from __future__ import annotations

import os
import sys

from edge_runtime.cli import program, run_cli

COMMANDS = {
    "simulate": ("bridge.simulate", "serve an environment to an edge runtime"),
    "sense": ("bridge.ports:sense", "serve a robot's own sensors in place of a simulator"),
    "router": ("bridge.ports:router", "connect simulators, edge runtimes and viewers"),
    "record": ("bridge.ports:record", "write everything on the wire to an MCAP recording"),
    "replay": ("bridge.replay", "run recorded states through a policy, and compare"),
    "shadow": ("bridge.shadow", "run a second policy beside the driving one, moving nothing"),
    "fork": ("bridge.fork", "rebuild a recorded drive up to a moment, and drive on from there"),
    "export": ("bridge.lerobot", "turn a recording into a LeRobot data set"),
    "view": ("bridge.ports:view", "show the wire in rerun, live or in a file"),
}
main = program(
    "python -m bridge",
    "The simulator's side of the wire.",
    COMMANDS,
    "python -m bridge simulate --env Pendulum-v1 --episodes 5 --clock realtime",
    "python -m bridge view --serve",
)

if __name__ == "__main__":
    status = run_cli(main)
    if sys.argv[1:2] == ["sense"]:  # The interpreter's exit would wait for a source's threads.
        os._exit(status)
    sys.exit(status)
