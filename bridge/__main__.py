"""``python -m bridge``: the simulator's side of the wire."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from bridge import record, replay, simulate, view
from bridge.recording import repair
from edge_runtime.cli import ArgumentParser, run_cli


class Subcommand(NamedTuple):
    """One row of SUBCOMMANDS."""

    add_arguments: Callable[[ArgumentParser], None]
    run: Callable[[Any], int]
    help: str


SUBCOMMANDS = {
    "simulate": Subcommand(
        simulate.add_arguments,
        simulate.simulate,
        "serve an environment to an edge runtime over Zenoh, and report",
    ),
    "record": Subcommand(
        record.add_arguments, record.record, "write everything on the wire to an MCAP recording"
    ),
    "repair": Subcommand(
        repair.add_arguments, repair.repair, "give a recording that was cut off its index back"
    ),
    "replay": Subcommand(
        replay.add_arguments,
        replay.replay,
        "run recorded states through a policy or runtime, and compare its commands",
    ),
    "view": Subcommand(view.add_arguments, view.view, "show the wire in rerun, live or in a file"),
}


def main(argv: list[str]) -> int:
    """Run one subcommand and return its exit status."""
    parser = ArgumentParser(prog="python -m bridge", description=__doc__)
    subparsers = parser.add_subparsers(dest="subcommand", required=True, metavar="COMMAND")
    for name, row in SUBCOMMANDS.items():
        row.add_arguments(subparsers.add_parser(name, help=row.help, description=row.help))
    arguments = parser.parse_args(argv)
    return SUBCOMMANDS[arguments.subcommand].run(arguments)


if __name__ == "__main__":
    sys.exit(run_cli(main))
