"""The command line: `python -m edge_runtime check | run | status | rearm`."""

from __future__ import annotations

import argparse
import sys
from typing import Callable, List

from edge_runtime import __version__, log
from edge_runtime.cli import ArgumentParser, add_public_key, examples, run_cli
from edge_runtime.config import VEHICLE_NAMES, Config

_DEFAULTS = Config()
_TRUSTED = "results/policies/left_turn.onnx \\\n    --public-key results/policies/policy.pub"
_EXAMPLES = {
    "check": (
        f"python -m edge_runtime check {_TRUSTED}",
        "python -m edge_runtime check my.onnx --allow-unsigned --out check.json",
    ),
    "run": (
        f"python -m edge_runtime run --policy {_TRUSTED}",
        "python -m edge_runtime run --policy my.onnx --vehicle hunter --bus socketcan:can0 \\\n"
        "    --connect tls/10.0.0.2:7447 --tls certs/edge-hunter01 --vehicle-id hunter01",
        "python -m edge_runtime run --config edge.toml --log-format json",
    ),
    "status": (
        "python -m edge_runtime status",
        "python -m edge_runtime status --connect tcp/10.0.0.2:7447 --vehicle-id hunter01 --json",
    ),
    "rearm": (
        "python -m edge_runtime rearm",
        "python -m edge_runtime rearm --connect tls/10.0.0.2:7447 \\\n"
        "    --tls certs/operator-hunter01 --vehicle-id hunter01",
    ),
}
"""Of each command; the first one works in a fresh clone."""


# The options of `run`: flag, metavar, help.
_RUN_OPTIONS = (
    ("--policy", "POLICY.onnx", "the policy file"),
    ("--connect", "PROTOCOL/HOST:PORT", "where the simulator listens"),
    ("--vehicle-id", "ID", "the vehicle's part of the Zenoh keys"),
    ("--vehicle", "|".join(VEHICLE_NAMES), "the vehicle to move besides"),
    ("--bus", "INTERFACE:CHANNEL", "with --vehicle hunter: its CAN bus, as python-can names it"),
    ("--config", "FILE.toml", "settings; flags on the command line win over it"),
    ("--log-level", "|".join(log.LEVELS), "least level that goes to stderr"),
    ("--log-format", "|".join(log.FORMATS), "a line of words, or a JSON object a line"),
)


def main() -> None:
    """The entry point of `phil-edge`."""
    sys.exit(run_cli(dispatch))


def dispatch(argv: List[str]) -> int:
    """Parse and run one command; each is imported only when it is asked for."""
    arguments = build_parser().parse_args(argv)
    if arguments.command == "run":
        from edge_runtime.run import run

        return run(arguments)
    from edge_runtime import commands

    command: Callable[[argparse.Namespace], int] = getattr(commands, arguments.command)
    return command(arguments)


def build_parser() -> ArgumentParser:
    """The parser of all commands."""
    parser = ArgumentParser(
        prog="python -m edge_runtime",
        description="Drives a verified policy over Zenoh, and stops safely when in doubt.",
        epilog=examples(*(commands[0] for commands in _EXAMPLES.values())),
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str) -> ArgumentParser:
        shown = examples(*_EXAMPLES[name])
        added: ArgumentParser = commands.add_parser(name, help=text, description=text, epilog=shown)
        return added

    _add_check(add("check", "may this policy drive, and how fast is it here"))
    _add_run(add("run", "answer states with commands until a signal ends it"))
    _add_operator(add("status", "print how a running edge runtime is"), with_out=True)
    _add_operator(add("rearm", "let a vehicle drive again after a safe stop"), with_out=False)
    return parser


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", metavar="POLICY.onnx", help="the policy file")
    parser.add_argument("--out", metavar="FILE.json", help="write the report here, too")
    _add_trust(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    for flag, metavar, text in _RUN_OPTIONS:
        # Shown only: a flag that is not given leaves the file's setting as it is.
        default = getattr(_DEFAULTS, flag[2:].replace("-", "_"), None)
        shown = f"{text} (default: {default})" if default else text
        parser.add_argument(flag, metavar=metavar, help=shown)
        if flag == "--connect":
            _add_tls(parser)
    _add_trust(parser)


def _add_trust(parser: argparse.ArgumentParser) -> None:
    add_public_key(parser)
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
    connect, vehicle_id = _DEFAULTS.connect, _DEFAULTS.vehicle_id
    where = "where the simulator listens"
    parser.add_argument("--connect", metavar="PROTOCOL/HOST:PORT", default=connect, help=where)
    _add_tls(parser)
    parser.add_argument("--vehicle-id", metavar="ID", default=vehicle_id, help="which vehicle")
    if with_out:
        parser.add_argument("--out", metavar="FILE.json", help="write all of it here, as JSON")
        parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


if __name__ == "__main__":
    main()
