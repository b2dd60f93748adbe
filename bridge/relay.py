"""``python -m bridge relay``: a slow and lossy network between a simulator and an edge runtime.

Both ends are unmodified: the edge runtime connects to ``--listen``, the relay to the simulator at
``--connect``. Through the model pass states (up), commands, feedback and health (down). Status and
re-arm queries and the liveliness tokens pass at once: they observe the loop, and are no part of it.
"""

from __future__ import annotations

import time
from typing import Any

from bridge.arguments import add_vehicle_id
from bridge.relay_ends import Relay, open_relay
from bridge.signals import sigterm_as_interrupt, wait_to_be_told
from edge_runtime.cli import ArgumentParser, examples, not_negative
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.latency.model import GRAMMAR, LatencySpec, parse_spec
from edge_runtime.transport import check_endpoint, is_tls
from edge_runtime.util import UserError
from edge_runtime.wire import check_vehicle_id

EXAMPLE = examples(
    "python -m bridge relay --listen tcp/127.0.0.1:7448 --connect tcp/127.0.0.1:7447 \\\n"
    "    --latency 50ms+-10ms,loss=1% --out relay.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        required=True,
        help="where the edge runtime connects to",
    )
    parser.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        required=True,
        help="where the simulator listens; it may come later",
    )
    network = "injected network: " + GRAMMAR.replace("%", "%%")
    parser.add_argument("--latency", metavar="SPEC", default="none", help=network)
    parser.add_argument(
        "--seed", metavar="N", type=not_negative, default=0, help="of delays and losses"
    )
    add_vehicle_id(parser, "the vehicle to relay")
    parser.add_argument(
        "--out", metavar="R.json", help="write the counts to this file at the end (SIGTERM or ^C)"
    )


def run(arguments: Any) -> int:
    """Run the command until it is told to end; UserError for anything the caller can put right."""
    spec = _check(arguments)
    began_s = time.monotonic()
    with sigterm_as_interrupt():
        try:
            with open_relay(
                arguments.listen, arguments.connect, arguments.vehicle_id, spec, arguments.seed
            ) as running:
                _carry(arguments, spec, running)
        except KeyboardInterrupt:
            return 0  # Told to end before it had begun.
    report = _report(arguments, spec, running, time.monotonic() - began_s)
    write_json_out(arguments.out, report)
    print(_summary(report))
    return 0


def _carry(arguments: Any, spec: LatencySpec, running: Relay) -> None:
    """Zenoh's threads do the work; being interrupted is the ordinary end."""
    try:
        print(
            f"ready vehicle_id={arguments.vehicle_id} listen={arguments.listen}"
            f" connect={arguments.connect} latency={spec}",
            flush=True,
        )
        wait_to_be_told()
    except KeyboardInterrupt:
        return


def _check(arguments: Any) -> LatencySpec:
    for endpoint in (arguments.listen, arguments.connect):
        _check_plain(check_endpoint(endpoint))
    if arguments.listen == arguments.connect:
        raise UserError(f"--listen and --connect are both {arguments.listen}: that is a circle")
    check_vehicle_id(arguments.vehicle_id)
    if arguments.out is not None:
        check_writable(arguments.out)
    return parse_spec(arguments.latency)


def _check_plain(endpoint: str) -> None:
    """With TLS it would need two certificates: a simulator to one end, an edge to the other."""
    if is_tls(endpoint):
        raise UserError(
            f"endpoint {endpoint} is not for the relay: it speaks plain text only, for the bench;"
            " use tcp/ or udp/"
        )


def _report(arguments: Any, spec: LatencySpec, running: Relay, duration_s: float) -> dict[str, Any]:
    return {
        "vehicle_id": arguments.vehicle_id,
        "listen": arguments.listen,
        "connect": arguments.connect,
        "latency_spec": str(spec),
        "seed": arguments.seed,
        "duration_s": round(duration_s, 3),
        **running.traffic.report(),
        "queries": running.queries,
    }


def _summary(report: dict[str, Any]) -> str:
    parts = [
        f"{name} {row['delivered']} of {row['received']}" for name, row in report["topics"].items()
    ]
    return (
        f"delivered: {', '.join(parts)}; timers late by p99 {report['timer_lag_ms']['p99']:.2f} ms"
    )
