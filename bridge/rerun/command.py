"""``python -m bridge view``: its options. What runs it loads rerun, which takes a second."""

import argparse
from typing import Any

from bridge.ports import add_options
from bridge.rerun import add_sink
from edge_runtime.cli import command, whole_number
from edge_runtime.wire import DEFAULT_VEHICLE_ID

FOXGLOVE_PORT = 8765  # Where Foxglove looks first


@command(
    "bridge.rerun.wire_view:run",
    "python -m bridge view --serve",
    "python -m bridge view --save drive.rrd --wait-s 60",
    "python -m bridge view drive.mcap --save drive.rrd",
    "python -m bridge view --foxglove",
)
def view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording",
        nargs="?",
        metavar="F.mcap",
        help="show what bridge record has written, instead of listening",
    )
    text = f"serve Foxglove, on this machine's loopback only (port {FOXGLOVE_PORT} if none is said)"
    port: dict[str, Any] = {"type": whole_number(1, 65535), "const": FOXGLOVE_PORT}
    add_sink(parser).add_argument("--foxglove", nargs="?", metavar="PORT", help=text, **port)
    add_options(parser, "--connect", "--tls", "--wait-s", "--duration-s")
    help_text = (
        f"the vehicle to watch (default: {DEFAULT_VEHICLE_ID}; of a recording: the only one)"
    )
    add_options(parser, "--vehicle-id", default=None, help=help_text)
