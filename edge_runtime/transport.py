"""Zenoh sessions with explicit endpoints: no scouting, no gossip, quick to notice a lost peer.

The simulator is a `router` that listens, the edge runtime a `peer` that connects and goes on
trying, and viewers and operators' commands are `client`s that fail at once with nobody there.
"""

from __future__ import annotations

import errno
import json
import re
import socket
from typing import Any, Dict, List, Optional

import zenoh

from edge_runtime.errors import UserError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MODES = ("router", "peer", "client")

# At Zenoh's default lease a peer that was stopped, or whose cable was cut, lives on for 10 s.
LEASE_MS = 1000
# Back within 1 s of a link's return leaves 0.5 s for this: five fresh states take the rest.
RETRY = {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5}

_ENDPOINT = re.compile(r"(tcp|udp)/(\[[0-9A-Fa-f:.]+\]|[^\s\[\]/:]+):(\d{1,5})")


def check_endpoint(endpoint: str) -> str:
    """The endpoint itself; UserError if it is not PROTOCOL/HOST:PORT."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match.group(3)) <= 65535:
        raise UserError(
            f"endpoint {endpoint!r} is not valid: write it as {DEFAULT_ENDPOINT} (tcp or udp)"
        )
    return endpoint


def open_session(
    listen: Optional[str] = None, connect: Optional[str] = None, mode: str = "peer"
) -> zenoh.Session:
    """Open a session that listens, connects, or both. Close it before the process ends.

    Raises UserError for a malformed endpoint, a busy port, and, in client mode, nobody there.
    """
    if mode not in MODES:
        raise ValueError(f"mode {mode!r} is none of {MODES}")
    for endpoint in (listen, connect):
        if endpoint is not None:
            check_endpoint(endpoint)
    if listen is not None:
        _check_port_is_free(listen)
    try:
        return zenoh.open(_config(listen, connect, mode))
    except zenoh.ZError as error:
        raise UserError(_explain(str(error), listen, connect)) from None


def _config(listen: Optional[str], connect: Optional[str], mode: str) -> zenoh.Config:
    rows: Dict[str, Any] = {
        "mode": mode,
        # Explicitly none: a peer would otherwise listen on every interface.
        "listen/endpoints": _listed(listen),
        "connect/endpoints": _listed(connect),
        "connect/retry": RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Nothing is looked for, so there is nothing to wait for either (0.5 s at each start).
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        # It would map 17 MB for messages of 7 KB, and share them with any local process.
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for name, value in rows.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _listed(endpoint: Optional[str]) -> List[str]:
    return [] if endpoint is None else [endpoint]


def _check_port_is_free(endpoint: str) -> None:
    """Zenoh's own message for a busy port names neither the port nor the cause."""
    protocol, address = endpoint.split("/", 1)
    host, port = address.rsplit(":", 1)
    kind = socket.SOCK_STREAM if protocol == "tcp" else socket.SOCK_DGRAM
    try:
        family, _, _, _, target = socket.getaddrinfo(host.strip("[]"), int(port), type=kind)[0]
    except OSError:
        raise UserError(f"host {host!r} of endpoint {endpoint} cannot be resolved") from None
    with socket.socket(family, kind) as probe:
        if (
            kind == socket.SOCK_STREAM
        ):  # as the listener does: the last run's closed links are no bar
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(target)
        except OSError as error:
            raise UserError(_explain_bind(error, host, port)) from None


def _explain_bind(error: OSError, host: str, port: str) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {port} on {host} is in use; choose another with --listen"
    return f"cannot listen on port {port} of {host}: {error.strerror}"


def _explain(text: str, listen: Optional[str], connect: Optional[str]) -> str:
    if connect is not None and listen is None:
        return (
            f"nobody answers at {connect}; start the simulator first, or name its address with"
            " --connect"
        )
    return f"Zenoh cannot open {listen or connect}: {text}"


def free_endpoint() -> str:
    """A Zenoh endpoint on loopback that nobody listens on, for demos and tests."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
