"""What else Zenoh offers for this link: QUIC, best effort, large packets; measured by a bare echo.

``python -m hil_tests.network.variants --out V.json``
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from bridge.network import parse_spec
from bridge.report import quantiles
from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, run_cli
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError
from hil_tests.commands import BackgroundCommand
from hil_tests.network.cells import JUMBO_MTU, PORT
from hil_tests.network.echo import READY, zenoh_config
from hil_tests.network.kernel import MTU, kernel_network
from hil_tests.network.throwaway_tls import write_tls
from hil_tests.network.tun_bridge import SIMULATOR_ADDRESS

RELIABLE, BEST_EFFORT = "reliable", "best_effort"


class Variant(NamedTuple):
    """One row: how the two ends of the echo talk."""

    protocol: str
    reliability: str = RELIABLE
    mtu: int = MTU
    metadata: str = ""
    """Zenoh's endpoint metadata. ``rel=0`` is QUIC's datagrams, ``rel=1`` on UDP is QUIC without
    encryption, ``mixed_rel=1`` sends best effort in datagrams beside a reliable stream (the last
    two: Zenoh 1.10, not the 1.5.1 of Python 3.8)."""


VARIANTS = {
    "tcp": Variant("tcp"),
    "tcp best effort": Variant("tcp", BEST_EFFORT),
    "tls": Variant("tls"),
    "udp": Variant("udp"),
    "udp best effort": Variant("udp", BEST_EFFORT),
    "udp mtu 9000": Variant("udp", mtu=JUMBO_MTU),
    "udp rel=1": Variant("udp", metadata="?rel=1"),
    "udp mixed": Variant("udp", BEST_EFFORT, metadata="?rel=1;mixed_rel=1"),
    "quic": Variant("quic"),
    "quic best effort": Variant("quic", BEST_EFFORT),
    "quic rel=0": Variant("quic", BEST_EFFORT, metadata="?rel=0"),
    "quic mixed": Variant("quic", BEST_EFFORT, metadata="?mixed_rel=1"),
}


def main(argv: list[str]) -> int:
    """Measure all variants and print one line for each."""
    parser = ArgumentParser(
        prog="python -m hil_tests.network.variants",
        description=__doc__,
        epilog=examples("python -m hil_tests.network.variants --messages 100 --out runs/v.json"),
    )
    parser.add_argument("--latency", default="25ms+-5ms,loss=1%", help="as of bridge simulate")
    parser.add_argument("--messages", type=positive, default=600, help="to send, one each 0.1 s")
    parser.add_argument("--repeats", type=positive, default=1, help="new connections of each")
    parser.add_argument("--seed", type=not_negative, default=0, help="of delays and losses")
    parser.add_argument("--jobs", type=positive, default=1, help="variants that run at once")
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--out", metavar="V.json", help="write the numbers to this file")
    return _run(parser.parse_args(argv))


def _run(arguments: argparse.Namespace) -> int:
    spec = parse_spec(arguments.latency)
    if arguments.out is not None:
        check_writable(arguments.out)
    with kernel_network(spec, arguments.seed, "first"):
        """Says once, before any thread, that this machine cannot."""
    with ThreadPoolExecutor(arguments.jobs) as pool:
        rows = list(pool.map(lambda name: _row(arguments, name), arguments.only))
    for row in rows:
        print(json.dumps(row))
    result = {"latency_spec": str(spec), "messages": arguments.messages, "rows": rows}
    write_json_out(arguments.out, result)
    return 0


def _row(arguments: argparse.Namespace, name: str) -> dict[str, Any]:
    """A connection that never carried an answer is dead, and in none of the quantiles."""
    living: list[float | None] = []
    dead: list[str] = []
    for repeat in range(arguments.repeats):
        try:
            times_ms = _measure(arguments, name, arguments.seed + repeat)
        except UserError as error:
            dead.append(str(error))
            continue
        if any(time_ms is not None for time_ms in times_ms):
            living += times_ms
        else:
            dead.append("connected, but nothing was answered")
    found = {"variant": name, "connections": arguments.repeats, "dead": dead}
    return {**found, **_summary(living)} if living else found


def _measure(arguments: argparse.Namespace, name: str, seed: int) -> list[float | None]:
    variant, spec = VARIANTS[name], parse_spec(arguments.latency)
    endpoint = f"{variant.protocol}/{SIMULATOR_ADDRESS}:{PORT}{variant.metadata}"
    common = ("--reliability", variant.reliability, "--messages", str(arguments.messages))
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        tls = folder if variant.protocol in ("tls", "quic") else None
        if tls:
            write_tls(folder, SIMULATOR_ADDRESS)
        listen = zenoh_config(folder, "listen", endpoint, None, tls)
        connect = zenoh_config(folder, "connect", None, endpoint, tls)
        tag = f"v{list(VARIANTS).index(name)}"
        with (
            kernel_network(spec, seed, tag, variant.mtu) as cable,
            BackgroundCommand(
                "hil_tests.network.echo", "answer", "--config", str(connect), *common,
                ready=READY, prefix=cable.edge,
            ),
        ):  # fmt: skip
            command = ["hil_tests.network.echo", "ask", "--config", str(listen), *common]
            return _ask([*cable.simulator, sys.executable, "-m", *command])


def _ask(command: list[str]) -> list[float | None]:
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise UserError((done.stderr.strip().splitlines() or ["it said nothing"])[-1])
    round_trips: list[float | None] = json.loads(done.stdout)
    return round_trips


def _summary(round_trips_ms: list[float | None]) -> dict[str, Any]:
    answered = [time_ms for time_ms in round_trips_ms if time_ms is not None]
    return {
        "round_trip_ms": quantiles(answered),
        "unanswered_percent": 100.0 * (1 - len(answered) / len(round_trips_ms)),
        "over_2t_percent": 100.0 * sum(ms > 200.0 for ms in answered) / len(round_trips_ms),
    }


if __name__ == "__main__":
    sys.exit(run_cli(main))
