"""The command line: `python -m edge_runtime`, or `phil-edge` where the wheel is installed."""

from __future__ import annotations

import os

from edge_runtime.cli import program, run_cli

COMMANDS = {
    "check": ("edge_runtime.commands:CHECK", "say whether a policy may drive, and how fast it is"),
    "run": ("edge_runtime.run", "drive a policy: answer each state of a simulator until ^C"),
    "status": ("edge_runtime.commands:STATUS", "print the status of a running edge runtime"),
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
    status = run_cli(main)  # it has flushed what it printed
    # The interpreter's exit would wait for a thread that hangs, or that a driver left behind.
    os._exit(status)


if __name__ == "__main__":
    script()
