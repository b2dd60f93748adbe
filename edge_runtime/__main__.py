"""The command line: `python -m edge_runtime`, or `phil-edge` where the wheel is installed."""

from __future__ import annotations

import sys
from typing import List

from edge_runtime.cli import ArgumentParser, dispatch, examples, run_cli

COMMANDS = {
    "check": ("edge_runtime.commands:CHECK", "say whether a policy may drive, and how fast it is"),
    "run": ("edge_runtime.run", "answer states with commands until a signal ends it"),
    "status": ("edge_runtime.commands:STATUS", "print how a running edge runtime is"),
    "rearm": ("edge_runtime.commands:REARM", "let a vehicle drive again after a safe stop"),
}


def main(argv: List[str]) -> int:
    """Run one of the commands and return its exit status."""
    trusted = "my.onnx \\\n    --public-key keys/policy.pub"
    parser = ArgumentParser(
        prog="python -m edge_runtime",
        description="Drives a verified policy over Zenoh, and stops safely when in doubt.",
        epilog=examples(
            f"python -m edge_runtime check {trusted}",
            f"python -m edge_runtime run --policy {trusted}",
            "python -m edge_runtime status",
        ),
    )
    return dispatch(parser, COMMANDS, argv)


def script() -> None:
    """The entry point of `phil-edge`."""
    sys.exit(run_cli(main))


if __name__ == "__main__":
    script()
