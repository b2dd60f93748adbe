"""``python -m deploy router``: one file that makes a Zenoh router a fleet's, for zenohd."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy.router_config import router_config
from edge_runtime.cli import examples
from edge_runtime.files import check_writable, write_json
from edge_runtime.tls import load_tls
from edge_runtime.transport import check_endpoint, check_fits
from edge_runtime.util import UserError, read_bytes

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


def router(arguments: argparse.Namespace) -> int:
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
