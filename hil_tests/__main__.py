"""``python -m hil_tests``: the loop, proven without hardware."""

from __future__ import annotations

import sys

from edge_runtime.cli import ArgumentParser, run_cli
from hil_tests import demo
from hil_tests.network import command as network


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    parser = ArgumentParser(prog="python -m hil_tests", description="Proves the loop.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    summary = "train, export and drive the left turn, end to end"
    demo.add_arguments(commands.add_parser("demo", help=summary, description=summary))
    summary = "the left turn over a kernel's TCP and UDP, against the model in two kinds of time"
    network.add_arguments(commands.add_parser("network", help=summary, description=summary))
    arguments = parser.parse_args(argv)
    return {"demo": demo.run, "network": network.run}[arguments.command](arguments)


if __name__ == "__main__":
    sys.exit(run_cli(main))
