"""What the bridge's commands share: the table of their options, the bar, and how they wait."""

from __future__ import annotations

import sys
import time
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bridge.network import GRAMMAR, parse_spec
from edge_runtime.cli import not_negative, seconds
from edge_runtime.files import check_writable
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

_LOOK_S = 0.2


def writable(path: str) -> str:
    """The path itself; UserError where no report could be written there later."""
    check_writable(path)
    return path


ENDPOINT = {"metavar": "PROTOCOL/HOST:PORT", "type": check_endpoint}
_SECONDS = {"metavar": "SECONDS", "type": seconds}
OPTIONS: dict[str, dict[str, Any]] = {
    "--listen": {**ENDPOINT, "help": "where the edge runtime and viewers connect to"},
    "--connect": {
        **ENDPOINT,
        "default": DEFAULT_ENDPOINT,
        "help": "where the simulator or the router listens",
    },
    "--tls": {
        "metavar": "DIR",
        "help": "ca.pem, cert.pem, key.pem of this party (python -m deploy certs);"
        " endpoint tls/...",
    },
    "--vehicle-id": {
        "metavar": "ID",
        "type": check_vehicle_id,
        "default": DEFAULT_VEHICLE_ID,
        "help": "the vehicle",
    },
    "--wait-s": {
        **_SECONDS,
        "default": 10.0,
        "help": "how long to wait for a simulator, in seconds",
    },
    "--duration-s": {
        **_SECONDS,
        "help": "stop after this many seconds (otherwise when no simulator is left)",
    },
    "--wait-edge-s": {
        **_SECONDS,
        "default": 30.0,
        "help": "how long to wait for an edge runtime, in seconds",
    },
    "--latency": {
        "metavar": "SPEC",
        "type": parse_spec,
        "default": "none",
        "help": "injected network: " + GRAMMAR.replace("%", "%%"),
    },
    "--seed": {
        "metavar": "N",
        "type": not_negative,
        "default": 0,
        "help": "of delays and losses",
    },
    "--out": {"metavar": "R.json", "type": writable, "help": "write the report to this file"},
}
"""The options that several commands have; their types raise UserError for a bad value."""


def add_options(parser: Any, *names: str, **changes: Any) -> None:
    """Declare options of the table; ``changes`` are this command's own help, default and so on."""
    for name in names:
        parser.add_argument(name, **{**OPTIONS[name], **changes})


def wait_to_be_told() -> NoReturn:
    """Sleep until KeyboardInterrupt (main thread only).

    The kernel may hand a signal to any thread, one of Zenoh's too. That does not wake this thread
    from a lock, so it looks again now and then.
    """
    while True:
        time.sleep(_LOOK_S)


def progress_bar(unit: str) -> Progress:
    """Make a bar on stderr that counts ``unit``; it shows nothing where stderr is no terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
