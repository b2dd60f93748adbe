"""``python -m bridge router``: one Zenoh router between several simulators, edges and viewers."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

from bridge.arguments import add_tls
from bridge.signals import sigterm_as_interrupt
from edge_runtime import access
from edge_runtime.cli import ArgumentParser
from edge_runtime.tls import tls_for
from edge_runtime.topics import DEFAULT_VEHICLE_ID, check_vehicle_id
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint, open_session


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


def router(arguments: Any) -> int:
    """Route until SIGTERM or ^C; without ``--tls``, everything that anybody sends."""
    listens = list(dict.fromkeys(arguments.listen or [DEFAULT_ENDPOINT]))
    vehicle_ids = list(map(check_vehicle_id, arguments.vehicle_id or [DEFAULT_VEHICLE_ID]))
    tls = tls_for(arguments.tls, *map(check_endpoint, listens))
    rules = None
    if tls is not None:
        access.check_name(tls.name, access.ROUTER)
        rules = access.rules_for_listener(vehicle_ids)
    with contextlib.suppress(KeyboardInterrupt), sigterm_as_interrupt():
        session = open_session(listen=listens, mode="router", tls=tls, access=rules)
        try:
            print(f"ready listen={','.join(listens)}", flush=True)
            threading.Event().wait()
        finally:
            session.close()
    return 0
