"""``python -m trainer``: train, evaluate, export."""

from __future__ import annotations

import sys

from edge_runtime.cli import ArgumentParser, examples, run_cli
from trainer.commands import COMMANDS


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    parser = ArgumentParser(
        prog="python -m trainer",
        description="Trains driving policies with human guidance, evaluates and exports them.",
        epilog=examples(
            "python -m trainer train --scenario left_turn --episodes 120 --out runs/phil_1",
            "python -m trainer evaluate runs/phil_1 --runs 50",
        ),
    )
    parsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        summary = (command.__doc__ or "").strip().splitlines()[0]
        sub = parsers.add_parser(name, help=summary, description=summary, epilog=command.EXAMPLE)
        command.add_arguments(sub)
    arguments = parser.parse_args(argv)
    return COMMANDS[arguments.command].run(arguments)


if __name__ == "__main__":
    sys.exit(run_cli(main))
