"""``python -m hil_tests``: the loop, proven without hardware."""

from __future__ import annotations

import sys

from edge_runtime.cli import ArgumentParser, run_cli
from hil_tests import demo


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    parser = ArgumentParser(prog="python -m hil_tests", description="Proves the loop.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    summary = "train, export and drive the left turn, end to end"
    demo.add_arguments(commands.add_parser("demo", help=summary, description=summary))
    return demo.run(parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(run_cli(main))
