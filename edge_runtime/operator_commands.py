"""`status` and `rearm`: what an operator asks a running edge runtime over Zenoh."""

from __future__ import annotations

import argparse
import json
from typing import Any, Dict, Optional

from edge_runtime import access
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable, parse_json, write_json
from edge_runtime.status_table import render_status
from edge_runtime.tls import TlsFiles, is_tls, tls_for
from edge_runtime.transport import check_endpoint, open_session
from edge_runtime.wire import key

_TIMEOUT_S = 2.0
_STRANGER = "what answers for {} is no edge runtime of this kind"


def status(arguments: argparse.Namespace) -> int:
    """Print the runtime's status as a table, or as JSON."""
    if arguments.out is not None:
        check_writable(arguments.out)
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    reply = ask(arguments.connect, arguments.vehicle_id, "status", tls)
    try:
        print(json.dumps(reply, indent=2) if arguments.json else render_status(reply))
    except (LookupError, TypeError, ValueError, AttributeError):
        raise UserError(_STRANGER.format(arguments.vehicle_id)) from None
    if arguments.out is not None:
        write_json(arguments.out, reply)
    return 0


def rearm(arguments: argparse.Namespace) -> int:
    """Let the runtime drive again. Raises UserError where it refuses."""
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    if tls is not None:
        access.check_name(tls.name, access.common_name(access.OPERATOR, arguments.vehicle_id))
    reply = ask(arguments.connect, arguments.vehicle_id, "rearm", tls)
    if reply.get("accepted") is not True:
        why = reply.get("detail", "it does not say why")
        raise UserError(f"{arguments.vehicle_id} was not re-armed: {why}")
    print(f"{arguments.vehicle_id} is re-armed; it drives after 5 fresh states in a row")
    return 0


def rearm_command(connect: str, vehicle_id: str) -> str:
    """What an operator types to let a vehicle drive again."""
    tls = f" --tls certs/operator-{vehicle_id}" if is_tls(connect) else ""
    return f"python -m edge_runtime rearm --connect {connect} --vehicle-id {vehicle_id}{tls}"


def ask(
    connect: str, vehicle_id: str, topic: str, tls: Optional[TlsFiles] = None
) -> Dict[str, Any]:
    """The JSON reply of a queryable of wire.TOPICS. Raises UserError where none comes in 2 s."""
    selector = key(vehicle_id, topic)
    session = open_session(connect=connect, mode="client", tls=tls)
    try:
        for reply in session.get(selector, timeout=_TIMEOUT_S):
            if reply.ok is not None:
                answer = parse_json(bytes(reply.ok.payload), f"the answer of {vehicle_id}")
                if not isinstance(answer, dict):
                    raise UserError(_STRANGER.format(vehicle_id))
                return answer
    finally:
        session.close()
    raise UserError(
        f"no edge runtime with vehicle id {vehicle_id} is connected to {connect};"
        " start one, or name it with --vehicle-id" + _hint(tls, topic)
    )


def _hint(tls: Optional[TlsFiles], topic: str) -> str:
    """A query without the right to it looks the same from here as a runtime that is not there."""
    return "" if tls is None else f"; or the certificate of {tls.name} may not ask for its {topic}"
