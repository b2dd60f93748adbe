"""``python -m deploy``: what goes onto the board, and onto it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from deploy import bundle_command, certs_command, push, router_command
from deploy.keys import DEFAULT_DIRECTORY, write_key_pair
from edge_runtime.cli import ArgumentParser, run_cli


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    arguments = build_parser().parse_args(argv)
    return {
        "keys": _keys,
        "certs": certs_command.certs,
        "bundle": bundle_command.bundle,
        "push": push.push,
        "router": router_command.router,
    }[arguments.command](arguments)


def build_parser() -> ArgumentParser:
    """The parser of all commands."""
    parser = ArgumentParser(
        prog="python -m deploy",
        description="Prepares what goes onto the board, and brings it there.",
        epilog="example: python -m deploy bundle --policy POLICY.onnx --target jetpack5",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    keys = commands.add_parser("keys", help="make a key pair that signs policies and bundles")
    keys.add_argument(
        "--out", default=DEFAULT_DIRECTORY, help="directory for policy.key and policy.pub"
    )
    certs_command.add_arguments(
        commands.add_parser("certs", help="make an authority and certificates for TLS")
    )
    bundle_command.add_arguments(
        commands.add_parser("bundle", help="make one signed archive for one board and vehicle")
    )
    push.add_arguments(commands.add_parser("push", help="bring a bundle to a board and install it"))
    router_command.add_arguments(
        commands.add_parser("router", help="write a fleet's router settings, for zenohd")
    )
    return parser


def _keys(arguments: Any) -> int:
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
