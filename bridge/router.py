"""``python -m bridge router``: one Zenoh router between several simulators, edges and viewers."""

from __future__ import annotations

import contextlib
from typing import Any

import zenoh

from bridge.commands import add_tls, wait_to_be_told
from edge_runtime import tls as access
from edge_runtime.cli import ArgumentParser, examples, sigterm_as_interrupt
from edge_runtime.tls import tls_for
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint, open_session
from edge_runtime.util import UserError, read_bytes
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

EXAMPLE = examples(
    "python -m bridge router --listen tcp/127.0.0.1:7447",
    "python -m bridge router --listen tls/0.0.0.0:7447 --tls certs/router \\\n"
    "    --vehicle-id hunter01 --vehicle-id hunter02",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        action="append",
        help=f"where all others connect to; may be repeated (default: {DEFAULT_ENDPOINT})",
    )
    add_tls(parser)
    parser.add_argument(
        "--vehicle-id",
        metavar="ID",
        action="append",
        help="a vehicle whose parties have rights here, with --tls; may be repeated"
        f" (default: {DEFAULT_VEHICLE_ID})",
    )
    parser.add_argument(
        "--config",
        metavar="FILE.json5",
        help="all settings from a file of `python -m deploy router`, and no other option",
    )


def run(arguments: Any) -> int:
    """Route until SIGTERM or ^C; without ``--tls``, everything that anybody sends."""
    if arguments.config is not None:
        if arguments.listen or arguments.tls or arguments.vehicle_id:
            raise UserError("--config goes with no other option: the file says it all")
        with contextlib.suppress(KeyboardInterrupt), sigterm_as_interrupt():
            _route(_open(arguments.config), f"config={arguments.config}")
        return 0
    listens = list(dict.fromkeys(arguments.listen or [DEFAULT_ENDPOINT]))
    vehicle_ids = list(map(check_vehicle_id, arguments.vehicle_id or [DEFAULT_VEHICLE_ID]))
    tls = tls_for(arguments.tls, *map(check_endpoint, listens))
    rules = None
    if tls is not None:
        access.check_name(tls.name, access.ROUTER)
        rules = access.rules_for_listener(vehicle_ids)
    with contextlib.suppress(KeyboardInterrupt), sigterm_as_interrupt():
        session = open_session(listen=listens, mode="router", tls=tls, access=rules)
        _route(session, f"listen={','.join(listens)}")
    return 0


def _route(session: zenoh.Session, what: str) -> None:
    try:
        print(f"ready {what}", flush=True)
        wait_to_be_told()
    finally:
        session.close()


def _open(path: str) -> zenoh.Session:
    """A router with the settings of a file, as zenohd would open it."""
    read_bytes(path, "router's config file")
    try:
        return zenoh.open(zenoh.Config.from_file(path))
    except zenoh.ZError as error:
        raise UserError(f"Zenoh opens no router with {path}: {error}") from None
