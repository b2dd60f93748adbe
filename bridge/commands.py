"""What the bridge's commands share: options, the bar that shows how far they are, and their end."""

from __future__ import annotations

import contextlib
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from edge_runtime.cli import seconds
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint
from edge_runtime.wire import DEFAULT_VEHICLE_ID


def add_connect(parser: ArgumentParser) -> None:
    """Declare ``--connect`` of a command that listens to the wire."""
    parser.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        default=DEFAULT_ENDPOINT,
        help="where the simulator or the router listens",
    )


def add_vehicle_id(parser: ArgumentParser, what: str) -> None:
    """Declare ``--vehicle-id`` of a command that is about one vehicle."""
    parser.add_argument("--vehicle-id", metavar="ID", default=DEFAULT_VEHICLE_ID, help=what)


def add_span(parser: ArgumentParser) -> None:
    """Declare ``--wait-s`` and ``--duration-s`` of a command that listens while simulators run."""
    parser.add_argument(
        "--wait-s",
        metavar="SECONDS",
        type=seconds,
        default=10.0,
        help="how long to wait for a simulator, in seconds",
    )
    parser.add_argument(
        "--duration-s",
        metavar="SECONDS",
        type=seconds,
        help="stop after this many seconds (otherwise when no simulator is left)",
    )


def add_wait_edge(parser: ArgumentParser) -> None:
    """Declare ``--wait-edge-s`` of a command that plays the simulator."""
    parser.add_argument(
        "--wait-edge-s",
        metavar="SECONDS",
        type=seconds,
        default=30.0,
        help="how long to wait for an edge runtime, in seconds",
    )


def add_tls(parser: ArgumentParser) -> None:
    """Declare ``--tls``; its value goes through ``edge_runtime.tls.tls_for``."""
    parser.add_argument(
        "--tls",
        metavar="DIR",
        help="ca.pem, cert.pem, key.pem of this party (python -m deploy certs); endpoint tls/...",
    )


def add_where(parser: ArgumentParser) -> None:
    """Declare --listen and --connect, of which one is taken (``check_where``)."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        help=f"where the edge runtime and viewers connect to (default: {DEFAULT_ENDPOINT})",
    )
    where.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        help="share a router with other vehicles instead of listening",
    )


def check_where(arguments: Any) -> tuple[str | None, str | None]:
    """Return listen and connect, of which one is an endpoint and the other None."""
    if arguments.connect is not None:
        return None, check_endpoint(arguments.connect)
    return check_endpoint(arguments.listen or DEFAULT_ENDPOINT), None


_LOOK_S = 0.2


def wait_to_be_told() -> NoReturn:
    """Sleep until KeyboardInterrupt (main thread only).

    The kernel may hand a signal to any thread, one of Zenoh's too, and that does not wake this one
    from a lock, where it would wait for ever: so it looks again, now and then.
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


@contextlib.contextmanager
def count_bar(unit: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar while the block runs; call what it yields with how many are done."""
    with progress_bar(unit) as progress:
        task = progress.add_task("replaying", total=total)
        yield lambda done: progress.update(task, completed=done)
