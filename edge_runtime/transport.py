"""Zenoh sessions with explicit endpoints: no scouting, no gossip, quick to notice a lost peer.

The simulator is a `router` that listens, the edge runtime a `peer` that connects and goes on
trying, and viewers and operators' commands are `client`s that fail at once with nobody there.
Behind a router of its own the simulator is a `client`, too: two peers would not hear each other.

Zenoh says "Unable to connect" whether nobody is there, the other end refuses us, or we refuse it;
`look` finds out which, with Python's own socket and ssl.
"""

from __future__ import annotations

import contextlib
import errno
import json
import re
import socket
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Optional, Sequence, Tuple, Union

import zenoh

from edge_runtime.util import UserError

if TYPE_CHECKING:
    from edge_runtime.tls import TlsFiles

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
TLS_PROTOCOLS = ("tls", "quic")

# At Zenoh's default lease a peer that was stopped, or whose cable was cut, lives on for 10 s.
LEASE_MS = 1000
# Back within 1 s of a link's return leaves 0.5 s for this: five fresh states take the rest.
RETRY = {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5}

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic)/(\[[0-9A-Fa-f:.]+\]|[^\s\[\]/:]+):(\d{1,5})")
_LOOK_S = 1.0
# A server that refuses a client's certificate says so after the handshake (TLS 1.3).
_ALERT_S = 0.3


def check_endpoint(endpoint: str) -> str:
    """The endpoint itself; UserError if it is not PROTOCOL/HOST:PORT."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match.group(3)) <= 65535:
        right = f"write it as {DEFAULT_ENDPOINT} (tcp or udp; tls or quic with --tls)"
        raise UserError(f"endpoint {endpoint!r} is not valid: {right}")
    return endpoint


def is_tls(endpoint: str) -> bool:
    """Whether the endpoint's protocol asks for certificates."""
    return endpoint.split("/", 1)[0] in TLS_PROTOCOLS


def check_fits(endpoint: str, with_tls: bool) -> None:
    """Raise UserError for a TLS endpoint without files, and for files with a plain endpoint."""
    if with_tls and not is_tls(endpoint):
        address = endpoint.split("/", 1)[1]
        right = f"write tls/{address}"
        raise UserError(f"endpoint {endpoint} would send plain text despite --tls: {right}")
    if not with_tls and is_tls(endpoint):
        where = "name a directory of `python -m deploy certs` with --tls"
        raise UserError(f"endpoint {endpoint} needs certificates: {where}")


def open_session(
    listen: Union[str, Sequence[str], None] = None,
    connect: Optional[str] = None,
    mode: str = "peer",
    tls: Optional[TlsFiles] = None,
    access: Optional[Dict[str, Any]] = None,
) -> zenoh.Session:
    """Open a session that listens, connects, or both. Close it before the process ends.

    `mode` is "router", "peer" or "client". `tls` is what `tls_for` gave. `access` is Zenoh's
    `access_control`, of tls.py; a session that listens with TLS must have it.
    Raises UserError for a malformed endpoint, one that does not go with `tls`, a busy port, a
    link that either end refuses, and, in client mode, nobody there.
    """
    listens = [listen] if isinstance(listen, str) else list(listen or [])
    if listens and tls is not None and access is None:
        raise ValueError("a TLS listener needs access control: any certificate could say all")
    for endpoint in [*listens, *([] if connect is None else [connect])]:
        check_fits(check_endpoint(endpoint), tls is not None)
    for endpoint in listens:
        _check_port_is_free(endpoint)
    config = zenoh.Config()
    for name, value in session_rows(listens, connect, mode, tls, access).items():
        config.insert_json5(name, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        if connect is None or listens:
            raise UserError(f"Zenoh cannot open {', '.join(listens) or connect}: {error}") from None
        raise UserError(_why_not_connected(connect, tls)) from None
    if connect is not None and tls is not None and not session.info.routers_zid():
        # A peer goes on trying for ever, also where it will never be let in: say so now.
        answers, why = look(connect, tls)
        if answers and why and not session.info.routers_zid():
            session.close()
            raise UserError(why)
    return session


def session_rows(
    listens: List[str],
    connect: Optional[str],
    mode: str,
    tls: Optional[TlsFiles],
    access: Optional[Dict[str, Any]],
) -> Dict[str, Any]:
    """Zenoh's settings of such a session, by their paths, as in `scouting/gossip/enabled`."""
    rows: Dict[str, Any] = {
        "mode": mode,
        # Explicitly none: a peer would otherwise listen on every interface.
        "listen/endpoints": listens,
        "connect/endpoints": [] if connect is None else [connect],
        "connect/retry": RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Nobody is scouted for, so there is nothing to wait for: half a second at every start.
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        # It would map 17 MB for messages of 7 KB, and share them with any local process.
        "transport/shared_memory/enabled": False,
    }
    if tls is not None:
        rows["transport/link/tls"] = tls.zenoh_rows()
        # A port that speaks TLS only, whatever an endpoint's metadata may ask for.
        rows["transport/link/protocols"] = list(TLS_PROTOCOLS)
    if access is not None:
        rows["access_control"] = access
    return rows


def only_own(key: str, hear: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
    """A subscriber's callback that takes only what was put to this very key.

    Zenoh gives it whatever intersects: a put to `phil/*/state` comes to every vehicle.
    """

    def take(sample: zenoh.Sample) -> None:
        if str(sample.key_expr) == key:
            hear(sample)

    return take


def look(endpoint: str, files: Optional[TlsFiles]) -> Tuple[bool, str]:
    """Whether anybody answers at `endpoint`, and why there is no link; "" if nothing forbids one.

    An endpoint of udp or quic is only resolved: there is nothing to connect to, and Python has no
    QUIC. Takes up to 1.3 s for each address of the host, and as long as the name server does.
    """
    protocol, host, port = _parts(endpoint)
    try:
        _address(endpoint)
    except OSError as error:
        return False, f"host {host!r} cannot be resolved ({error.strerror})"
    if _kind(protocol) != socket.SOCK_STREAM:
        return False, ""
    try:
        plain = socket.create_connection((host, port), timeout=_LOOK_S)
    except ConnectionRefusedError:
        return False, f"nobody listens on port {port} of {host} (connection refused)"
    except socket.timeout:
        return False, f"{host} does not answer within {_LOOK_S:.0f} s"
    except OSError as error:
        return False, f"{host} cannot be reached ({error.strerror})"
    with contextlib.closing(plain):
        why = _why_not_plain(plain) if files is None else _why_not_tls(plain, host, files)
    return True, why and f"{endpoint} {why}"


def _why_not_connected(endpoint: str, files: Optional[TlsFiles]) -> str:
    """Why a client that must have a link at once gets none, on one line."""
    answers, why = look(endpoint, files)
    if answers and why:
        return why
    if endpoint.startswith("quic/"):  # such a link does not say why it fails
        why = why or "or one end does not believe the other's certificate"
    help_ = "start the simulator first, or name its address with --connect"
    return f"nobody answers at {endpoint}{why and f': {why}'}; {help_}"


def _why_not_plain(plain: socket.socket) -> str:
    import ssl  # Here: a start with a link need not wait for it.

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(plain).close()
    except OSError as error:
        if "ALERT" not in (getattr(error, "reason", "") or ""):  # as an SSLError has it
            return "answers, but not as a simulator or a router does"
    return "listens with TLS and wants --tls, with tls/ for tcp/"


def _why_not_tls(plain: socket.socket, host: str, files: TlsFiles) -> str:
    import ssl

    context = ssl.create_default_context(cafile=files.ca)
    context.load_cert_chain(files.certificate, files.key)
    shaken = False
    try:
        with context.wrap_socket(plain, server_hostname=host) as link:
            shaken = True
            link.settimeout(_ALERT_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"shows a certificate that is not believed here: {error.verify_message}"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        if "alert" not in reason:
            return f"does not speak TLS ({reason})"
        needs = "both need one authority, and certificates that have not expired"
        return f"refuses the certificate of {files.name} ({reason}): {needs}"
    except OSError:  # A link that stays open, and silent, has been accepted.
        return "" if shaken else "answers, but not with TLS"
    return ""


def _check_port_is_free(endpoint: str) -> None:
    """Raise UserError where it cannot be had: Zenoh names neither the port nor the cause."""
    _, host, port = _parts(endpoint)
    try:
        family, kind, _, _, target = _address(endpoint)
    except OSError:
        raise UserError(f"host {host!r} of endpoint {endpoint} cannot be resolved") from None
    with socket.socket(family, kind) as probe:
        if kind == socket.SOCK_STREAM:
            # As the listener does: the last run's closed links are no bar.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(target)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                words = f"port {port} on {host} is in use; choose another with --listen"
            else:
                words = f"cannot listen on port {port} of {host}: {error.strerror}"
            raise UserError(words) from None


def free_endpoint(protocol: str = "tcp") -> str:
    """A Zenoh endpoint on loopback that nobody listens on, for demos and tests."""
    with socket.socket(type=_kind(protocol)) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def _kind(protocol: str) -> int:
    return socket.SOCK_STREAM if protocol in ("tcp", "tls") else socket.SOCK_DGRAM


def _parts(endpoint: str) -> Tuple[str, str, int]:
    protocol, address = endpoint.split("/", 1)
    host, port = address.rsplit(":", 1)
    return protocol, host.strip("[]"), int(port)


def _address(endpoint: str) -> Any:
    """The first of `socket.getaddrinfo`; OSError where the host cannot be resolved."""
    protocol, host, port = _parts(endpoint)
    try:
        return socket.getaddrinfo(host, port, type=_kind(protocol))[0]
    except UnicodeError as error:  # no host can have such a name
        raise OSError(None, str(error)) from None
