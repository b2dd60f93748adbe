"""``python -m hil_tests``: the loop, proven without hardware."""

from __future__ import annotations

import sys
from typing import Any

from edge_runtime.cli import ArgumentParser, run_cli
from hil_tests import demo
from hil_tests.board import command as board
from hil_tests.campaign import command as campaign
from hil_tests.fleet import command as fleet
from hil_tests.network import command as network

COMMANDS: dict[str, tuple[Any, str]] = {
    "demo": (demo, "train, export and drive the left turn, end to end"),
    "campaign": (campaign, "every fault, every latency row, one report"),
    "board": (board, "a bundle installed and driven on boards that are not there; needs root"),
    "fleet": (fleet, "a router with TLS and rights for many vehicles, and what each of them costs"),
    "network": (network, "the left turn over a kernel's TCP and UDP, and the model in two times"),
}


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    parser = ArgumentParser(prog="python -m hil_tests", description="Proves the loop.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (module, summary) in COMMANDS.items():
        module.add_arguments(commands.add_parser(name, help=summary, description=summary))
    arguments = parser.parse_args(argv)
    status: int = COMMANDS[arguments.command][0].run(arguments)
    return status


if __name__ == "__main__":
    sys.exit(run_cli(main))
