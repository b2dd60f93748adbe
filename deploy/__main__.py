"""``python -m deploy``: what goes onto the board, and onto it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from deploy import bundle, certs, push, router
from deploy.keys import DEFAULT_DIRECTORY, write_key_pair
from edge_runtime.cli import ArgumentParser, examples, run_cli


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    arguments = build_parser().parse_args(argv)
    return {
        "keys": _keys,
        "certs": certs.certs,
        "bundle": bundle.bundle,
        "push": push.push,
        "router": router.router,
    }[arguments.command](arguments)


def build_parser() -> ArgumentParser:
    """The parser of all commands."""
    parser = ArgumentParser(
        prog="python -m deploy",
        description="Prepares what goes onto the board, and brings it there.",
        epilog=examples(
            "python -m deploy keys --out keys",
            "python -m deploy bundle --policy results/policies/left_turn.onnx \\\n"
            "    --public-key results/policies/policy.pub --target jetpack5",
        ),
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, example: str) -> ArgumentParser:
        added: ArgumentParser = commands.add_parser(
            name, help=text, description=text, epilog=example
        )
        return added

    keys = add(
        "keys",
        "make a key pair that signs policies and bundles",
        examples("python -m deploy keys --out keys"),
    )
    keys.add_argument(
        "--out", default=DEFAULT_DIRECTORY, help="directory for policy.key and policy.pub"
    )
    for name, module, text in (
        ("certs", certs, "make an authority and certificates for TLS"),
        ("bundle", bundle, "make one signed archive for one board and vehicle"),
        ("push", push, "bring a bundle to a board and install it"),
        ("router", router, "write a fleet's router settings, for zenohd"),
    ):
        module.add_arguments(add(name, text, module.EXAMPLE))
    return parser


def _keys(arguments: Any) -> int:
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
