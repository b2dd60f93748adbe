"""A bare echo over Zenoh: 7.3 kB there, 217 B back, nothing else. One end in each namespace.

For what the loop's own ends do not offer, such as QUIC datagrams or best-effort publishers:
``python -m hil_tests.network.echo answer|ask --config FILE --reliability reliable|best_effort``.
The configuration is Zenoh's own. ``ask`` prints its round trips in ms as a JSON list, with null
for a message that was not answered.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
import time
from pathlib import Path
from typing import Any

import zenoh

from bridge.commands import wait_to_be_told
from edge_runtime.cli import ArgumentParser, examples, run_cli, sigterm_as_interrupt
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S

STATE_BYTES, COMMAND_BYTES = 7_322, 217
"""As long as the loop's own messages."""
THERE, BACK = "echo/state", "echo/command"
PATIENCE_S = 20.0
LAST_WAIT_S = 2.0
READY = "ready"
_NUMBER = struct.Struct("<I")


def main(argv: list[str]) -> int:
    """Run one end."""
    parser = ArgumentParser(
        prog="python -m hil_tests.network.echo",
        description=__doc__,
        epilog=examples("python -m hil_tests.network.echo ask --config zenoh.json5 --messages 100"),
    )
    parser.add_argument("role", choices=("answer", "ask"), help="which end this is")
    parser.add_argument("--config", required=True, help="Zenoh's configuration, JSON")
    parser.add_argument(
        "--reliability", choices=("reliable", "best_effort"), default="reliable",
        help="of the publisher",
    )  # fmt: skip
    parser.add_argument("--messages", type=int, default=600, help="to send, one each 0.1 s")
    arguments = parser.parse_args(argv)
    with sigterm_as_interrupt():
        session = zenoh.open(zenoh.Config.from_file(arguments.config))
        try:
            if arguments.role == "answer":
                answer(session, arguments)
            else:
                print(json.dumps(ask(session, arguments)))
        except KeyboardInterrupt:
            return 0
        finally:
            session.close()
    return 0


def answer(session: zenoh.Session, arguments: argparse.Namespace) -> None:
    """Send each number back until interrupted."""
    publisher = _publisher(session, BACK, arguments.reliability)
    padding = bytes(COMMAND_BYTES - _NUMBER.size)

    def came(sample: zenoh.Sample) -> None:
        publisher.put(sample.payload.to_bytes()[: _NUMBER.size] + padding)

    subscriber = session.declare_subscriber(THERE, came)
    print(READY, flush=True)
    try:
        wait_to_be_told()
    finally:
        subscriber.undeclare()
        publisher.undeclare()


def ask(session: zenoh.Session, arguments: argparse.Namespace) -> list[float | None]:
    """Send at the loop's pace and time the answers, in ms."""
    publisher = _publisher(session, THERE, arguments.reliability)
    sent_s: dict[int, float] = {}
    round_trips_ms: dict[int, float] = {}

    def came(sample: zenoh.Sample) -> None:
        (number,) = _NUMBER.unpack(sample.payload.to_bytes()[: _NUMBER.size])
        round_trips_ms.setdefault(number, (time.monotonic() - sent_s[number]) * 1e3)

    subscriber = session.declare_subscriber(BACK, came)
    try:
        _wait_for_listener(publisher)
        begun_s = time.monotonic()
        padding = os.urandom(STATE_BYTES - _NUMBER.size)
        for number in range(arguments.messages):
            time.sleep(max(0.0, begun_s + number * CONTROL_PERIOD_S - time.monotonic()))
            sent_s[number] = time.monotonic()
            publisher.put(_NUMBER.pack(number) + padding)
        time.sleep(LAST_WAIT_S)
    finally:
        subscriber.undeclare()
        publisher.undeclare()
    return [round_trips_ms.get(number) for number in range(arguments.messages)]


def _wait_for_listener(publisher: Any) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not publisher.matching_status.matching:
        if time.monotonic() > give_up_s:
            raise UserError(f"nobody answered within {PATIENCE_S:g} s")
        time.sleep(0.05)


def _publisher(session: zenoh.Session, key: str, reliability: str) -> Any:
    return session.declare_publisher(
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
        reliability=getattr(zenoh.Reliability, reliability.upper()),
    )


def zenoh_config(
    folder: Path, name: str, listen: str | None, connect: str | None, tls: Path | None
) -> Path:
    """Write the configuration of one end; the TLS files are those of ``deploy certs``."""
    rows: dict[str, Any] = {
        "mode": "router" if listen else "peer",
        "listen": {"endpoints": [listen] if listen else []},
        "connect": {"endpoints": [connect] if connect else [], "retry": {"period_max_ms": 500}},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    if tls is not None:
        files = {
            "root_ca_certificate": "ca.pem",
            "listen_private_key": "key.pem",
            "listen_certificate": "cert.pem",
        }
        rows["transport"] = {
            "link": {
                "tls": {key: str(tls / file) for key, file in files.items()}
                | {"enable_mtls": False, "verify_name_on_connect": False}
            }
        }
    path = folder / f"{name}.json"
    path.write_text(json.dumps(rows))
    return path


if __name__ == "__main__":
    sys.exit(run_cli(main))
