"""The console script ``phil``: ``phil FOLDER COMMAND`` is ``python -m FOLDER COMMAND``."""

from __future__ import annotations

import os
import sys

from edge_runtime.cli import program, run_cli

FOLDERS = {
    "trainer": "train a policy with a human's help, evaluate and export it",
    "edge_runtime": "drive a policy on the board",
    "bridge": "serve the simulator to a board; record, replay and view the wire",
    "hil_tests": "prove the loop without hardware",
    "deploy": "sign, pack and install what the board needs",
}


def main() -> None:
    if sys.argv[1:] and sys.argv[1] in FOLDERS:
        os.execv(sys.executable, [sys.executable, "-m", *sys.argv[1:]])
    commands = {name: (f"{name}.__main__", summary) for name, summary in FOLDERS.items()}
    what = "Human-guided driving policies, from training to the board."
    shown = ("phil hil_tests demo", "phil trainer train --help")
    sys.exit(run_cli(program("phil", what, commands, *shown)))
