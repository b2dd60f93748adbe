"""``python -m deploy``: what goes onto the board."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from deploy import certs_command, router_command
from deploy.keys import DEFAULT_DIRECTORY, write_key_pair
from edge_runtime.cli import ArgumentParser, run_cli


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    parser = ArgumentParser(
        prog="python -m deploy",
        description="Prepares what goes onto the board.",
        epilog="example: python -m deploy keys --out keys",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    keys = commands.add_parser("keys", help="make a key pair that signs policies")
    keys.add_argument(
        "--out", default=DEFAULT_DIRECTORY, help="directory for policy.key and policy.pub"
    )
    certs = commands.add_parser("certs", help="make an authority and certificates for TLS")
    certs_command.add_arguments(certs)
    router_command.add_arguments(
        commands.add_parser("router", help="write a fleet's router settings, for zenohd")
    )
    arguments = parser.parse_args(argv)
    return {"keys": _keys, "certs": certs_command.certs, "router": router_command.router}[
        arguments.command
    ](arguments)


def _keys(arguments: Any) -> int:
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
