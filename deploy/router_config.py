"""The settings of a fleet's router, in the file that zenohd reads. Pure.

They are those of `python -m bridge router --tls`, and the limits that a fleet needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from edge_runtime.tls import ROUTER, TlsFiles, check_name, rules_for_listener
from edge_runtime.transport import session_rows
from edge_runtime.util import UserError
from edge_runtime.wire import check_vehicle_id

SESSIONS_PER_VEHICLE = 4
"""Edge runtime, simulator, an operator's command, and the edge runtime's look at its start."""
SPARE_SESSIONS = 1000
"""Viewers; Zenoh's own default."""
MAX_MESSAGE_BYTES = 256 * 1024
"""Four times what an edge runtime reads. Larger ones end at the router; Zenoh itself says 1 GiB."""


def router_config(
    listens: Sequence[str], vehicle_ids: Sequence[str], tls: TlsFiles
) -> dict[str, Any]:
    """Zenoh's settings as one nested map.

    Args:
        listens: endpoints such as `tls/0.0.0.0:7447`.
        vehicle_ids: whose parties have rights here; all others are denied everything.
        tls: the files of the router's own certificate.

    Raises:
        UserError: another party's certificate, no vehicle, or a vehicle id that is not valid.
    """
    check_name(tls.name, ROUTER)
    if not vehicle_ids:
        raise UserError("no vehicle: name each with --vehicle-id, or all of them in --vehicles")
    ids = list(dict.fromkeys(map(check_vehicle_id, vehicle_ids)))
    rows = session_rows(list(listens), None, "router", tls, rules_for_listener(ids))
    sessions = SPARE_SESSIONS + SESSIONS_PER_VEHICLE * len(ids)
    return _nested(
        {
            **rows,
            "transport/unicast/max_sessions": sessions,
            # After a router's restart all of its vehicles come at once.
            "transport/unicast/accept_pending": sessions,
            "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        }
    )


def _nested(rows: Mapping[str, Any]) -> dict[str, Any]:
    """`{"a/b": 1}` as `{"a": {"b": 1}}`."""
    top: dict[str, Any] = {}
    for path, value in rows.items():
        *folders, name = path.split("/")
        place = top
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return top
