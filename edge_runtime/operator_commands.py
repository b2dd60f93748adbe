"""`status` and `rearm`: what an operator asks a running edge runtime over Zenoh."""

from __future__ import annotations

import argparse
import json
from typing import Any, Dict

from edge_runtime.errors import UserError
from edge_runtime.files import check_writable, write_json
from edge_runtime.status_table import render_status
from edge_runtime.transport import open_session
from edge_runtime.wire import key

_TIMEOUT_S = 2.0


def status(arguments: argparse.Namespace) -> int:
    """Print the runtime's status as a table, or as JSON."""
    if arguments.out is not None:
        check_writable(arguments.out)
    reply = ask(arguments.connect, arguments.vehicle_id, "status")
    print(json.dumps(reply, indent=2) if arguments.json else render_status(reply))
    if arguments.out is not None:
        write_json(arguments.out, reply)
    return 0


def rearm(arguments: argparse.Namespace) -> int:
    """Let the runtime drive again. Raises UserError where it refuses."""
    reply = ask(arguments.connect, arguments.vehicle_id, "rearm")
    if not reply["accepted"]:
        raise UserError(f"{arguments.vehicle_id} was not re-armed: {reply['detail']}")
    print(f"{arguments.vehicle_id} is re-armed; it drives after 5 fresh states in a row")
    return 0


def ask(connect: str, vehicle_id: str, topic: str) -> Dict[str, Any]:
    """The JSON reply of a queryable of wire.TOPICS. Raises UserError where none comes in 2 s."""
    selector = key(vehicle_id, topic)
    session = open_session(connect=connect, mode="client")
    try:
        for reply in session.get(selector, timeout=_TIMEOUT_S):
            if reply.ok is not None:
                return dict(json.loads(bytes(reply.ok.payload)))
    finally:
        session.close()
    raise UserError(
        f"no edge runtime with vehicle id {vehicle_id} is connected to {connect};"
        " start one, or name it with --vehicle-id"
    )
