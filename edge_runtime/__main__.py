"""The command line: `python -m edge_runtime`, or `phil-edge` where the wheel is installed."""

from __future__ import annotations

import os
import sys
import threading

from edge_runtime.cli import program, run_cli

COMMANDS = {
    "check": ("edge_runtime.commands:CHECK", "say whether a policy may drive, and how fast it is"),
    "run": ("edge_runtime.run", "answer states with commands until a signal ends it"),
    "status": ("edge_runtime.commands:STATUS", "print how a running edge runtime is"),
    "rearm": ("edge_runtime.commands:REARM", "let a vehicle drive again after a safe stop"),
}


_TRUSTED = "my.onnx \\\n    --public-key keys/policy.pub"
main = program(
    "python -m edge_runtime",
    "Drives a verified policy over Zenoh, and stops safely when in doubt.",
    COMMANDS,
    f"python -m edge_runtime check {_TRUSTED}",
    f"python -m edge_runtime run --policy {_TRUSTED}",
    "python -m edge_runtime status",
)


def script() -> None:
    """The entry point of `phil-edge`."""
    status = run_cli(main)
    if not all(one.daemon for one in threading.enumerate() if one is not threading.main_thread()):
        if sys.stderr is not None:
            sys.stderr.flush()
        os._exit(status)  # a driver left a thread of its own, and the exit would wait for that
    sys.exit(status)


if __name__ == "__main__":
    script()
