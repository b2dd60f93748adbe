"""``python -m deploy router``: the settings of a fleet's router, in the file that zenohd reads.

They are the settings of `python -m bridge router --tls`, and the limits that a fleet needs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_runtime.cli import examples
from edge_runtime.files import check_writable, write_json
from edge_runtime.tls import ROUTER, TlsFiles, check_name, load_tls, rules_for_listener
from edge_runtime.transport import check_endpoint, check_fits, session_rows
from edge_runtime.util import UserError, read_bytes
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


EXAMPLE = examples(
    "python -m deploy router --listen tls/0.0.0.0:7447 --tls certs/router \\\n"
    "    --vehicle-id hunter01 --vehicle-id hunter02 --out router.json5",
    "python -m deploy router --listen tls/0.0.0.0:7447 --tls certs/router --vehicles fleet.txt \\\n"
    "    --out router.json5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--listen",
        metavar="tls/HOST:PORT",
        action="append",
        required=True,
        help="where all others connect to, as tls/0.0.0.0:7447; may be repeated",
    )
    parser.add_argument(
        "--tls",
        metavar="DIR",
        required=True,
        help="the router's folder of `deploy certs`, as certs/router; zenohd opens its files",
    )
    parser.add_argument(
        "--vehicle-id",
        metavar="ID",
        action="append",
        default=[],
        help="a vehicle whose parties have rights at this router; may be repeated",
    )
    parser.add_argument("--vehicles", metavar="FILE", help="a file with one vehicle id a line")
    parser.add_argument("--out", metavar="FILE.json5", required=True, help="the settings' file")


def run(arguments: argparse.Namespace) -> int:
    """Write the file. Raises UserError where anything in it would not hold."""
    check_writable(arguments.out)
    for endpoint in arguments.listen:
        check_fits(check_endpoint(endpoint), with_tls=True)
    ids = arguments.vehicle_id + (_read(arguments.vehicles) if arguments.vehicles else [])
    settings = router_config(arguments.listen, ids, load_tls(arguments.tls))
    write_json(arguments.out, settings)
    size = Path(arguments.out).stat().st_size
    names = len(settings["access_control"]["subjects"])
    print(f"{arguments.out}: {len(set(ids))} vehicles, {names} names with rights, {size:,} bytes")
    print(f"start it:  zenohd --config {arguments.out}")
    print(f"or:        python -m bridge router --config {arguments.out}")
    return 0


def _read(path: str) -> list[str]:
    """One id a line; empty lines and `#` to the line's end are nothing."""
    try:
        text = read_bytes(path, "file of vehicles").decode()
    except UnicodeDecodeError:
        raise UserError(f"file of vehicles {path} is no text") from None
    return [word for line in text.splitlines() if (word := line.partition("#")[0].strip())]
