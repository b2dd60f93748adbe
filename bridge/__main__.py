"""``python -m bridge``: the simulator's side of the wire."""

from __future__ import annotations

import importlib
import sys

from edge_runtime.cli import ArgumentParser, examples, run_cli

SUBCOMMANDS = {
    "simulate": "serve an environment to an edge runtime over Zenoh, and report",
    "router": "connect several simulators, edge runtimes and viewers with one another",
    "relay": "put an injected network between a simulator and an edge runtime",
    "record": "write everything on the wire to an MCAP recording",
    "replay": "run recorded states through a policy or runtime, and compare its commands",
    "repair": "save what is whole of a recording that was cut off or damaged",
    "ros2": "show the wire to ROS 2, through a zenoh-bridge-ros2dds",
    "view": "show the wire in rerun, live or in a file",
}
"""By the name of its module in here, which has ``add_arguments``, ``EXAMPLE`` and a function of
that name."""
EXAMPLE = examples(
    "python -m bridge simulate --env left_turn --episodes 5 --clock realtime",
    "python -m bridge view --serve",
)


def main(argv: list[str]) -> int:
    """Run one subcommand and return its exit status."""
    parser = ArgumentParser(prog="python -m bridge", description=__doc__, epilog=EXAMPLE)
    subparsers = parser.add_subparsers(dest="subcommand", required=True, metavar="COMMAND")
    asked = next((word for word in argv if not word.startswith("-")), None)
    for name, text in SUBCOMMANDS.items():
        subparser = subparsers.add_parser(name, help=text, description=text)
        # Only what is asked for is loaded: a router need not wait for rerun and gymnasium.
        if name == asked:
            module = importlib.import_module(f"bridge.{name}")
            subparser.epilog = module.EXAMPLE
            module.add_arguments(subparser)
    arguments = parser.parse_args(argv)
    return int(getattr(module, arguments.subcommand)(arguments))


if __name__ == "__main__":
    sys.exit(run_cli(main))
