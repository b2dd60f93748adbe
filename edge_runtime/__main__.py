"""The command line: `python -m edge_runtime check | run | status | rearm`."""

from __future__ import annotations

import argparse
import sys
from typing import List

from edge_runtime import __version__, log
from edge_runtime.cli import ArgumentParser, run_cli
from edge_runtime.config import Config
from edge_runtime.vehicles.registry import VEHICLE_NAMES

_DEFAULTS = Config()


def main() -> None:
    """The entry point of `phil-edge`."""
    sys.exit(run_cli(dispatch))


def dispatch(argv: List[str]) -> int:
    """Parse and run one command; each is imported only when it is asked for."""
    arguments = build_parser().parse_args(argv)
    if arguments.command == "check":
        from edge_runtime.check_command import check as command
    elif arguments.command == "run":
        from edge_runtime.run_command import run as command
    elif arguments.command == "status":
        from edge_runtime.operator_commands import status as command
    else:
        from edge_runtime.operator_commands import rearm as command
    return command(arguments)


def build_parser() -> ArgumentParser:
    """The parser of all commands."""
    parser = ArgumentParser(
        prog="python -m edge_runtime",
        description="Drives a verified policy over Zenoh, and stops safely when in doubt.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_check(commands.add_parser("check", help="may this policy drive, and how fast is it here"))
    _add_run(commands.add_parser("run", help="answer states with commands until SIGTERM or ^C"))
    for name, text in (
        ("status", "print how a running edge runtime is"),
        ("rearm", "let a vehicle drive again after a safe stop"),
    ):
        _add_operator(commands.add_parser(name, help=text), with_out=name == "status")
    return parser


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", metavar="POLICY.onnx", help="the policy file")
    parser.add_argument("--out", metavar="FILE.json", help="write the report here, too")
    _add_trust(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--policy", metavar="POLICY.onnx", help="the policy file")
    parser.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        help=f"where the simulator listens (default: {_DEFAULTS.connect})",
    )
    _add_tls(parser)
    parser.add_argument(
        "--vehicle-id",
        metavar="ID",
        help=f"the vehicle's part of the Zenoh keys (default: {_DEFAULTS.vehicle_id})",
    )
    parser.add_argument(
        "--vehicle",
        metavar="|".join(VEHICLE_NAMES),
        help=f"the vehicle to move besides (default: {_DEFAULTS.vehicle})",
    )
    parser.add_argument(
        "--bus",
        metavar="INTERFACE:CHANNEL",
        help=f"the hunter's CAN bus, as python-can names it (default: {_DEFAULTS.bus})",
    )
    parser.add_argument(
        "--config", metavar="FILE.toml", help="settings; flags on the command line win over it"
    )
    parser.add_argument(
        "--log-level",
        metavar="|".join(log.LEVELS),
        help=f"least level that goes to stderr (default: {_DEFAULTS.log_level})",
    )
    parser.add_argument(
        "--log-format",
        metavar="|".join(log.FORMATS),
        help=f"a line of words, or a JSON object a line (default: {_DEFAULTS.log_format})",
    )
    _add_trust(parser)


def _add_trust(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--public-key",
        metavar="FILE",
        help="Ed25519 public key, PEM (default: keys/policy.pub where it exists)",
    )
    parser.add_argument(
        "--allow-unsigned",
        action="store_true",
        default=None,
        help="also take a policy whose origin cannot be verified",
    )


def _add_tls(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--tls",
        metavar="DIR",
        help="ca.pem, cert.pem, key.pem of this party (python -m deploy certs); endpoint tls/...",
    )


def _add_operator(parser: argparse.ArgumentParser, with_out: bool) -> None:
    parser.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        default=_DEFAULTS.connect,
        help="where the simulator listens",
    )
    _add_tls(parser)
    parser.add_argument(
        "--vehicle-id", metavar="ID", default=_DEFAULTS.vehicle_id, help="which vehicle"
    )
    if with_out:
        parser.add_argument("--out", metavar="FILE.json", help="write all of it here, as JSON")
        parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


if __name__ == "__main__":
    main()
