"""Why a link does not come about, or a port cannot be had: one look by Python's own socket and ssl.

Zenoh says "Unable to connect" whether nobody is there, the other end refuses us, or we refuse it.
An endpoint of udp or quic is only resolved: there is nothing to connect to, and Python has no QUIC.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import ssl
from typing import TYPE_CHECKING, Any, List, Optional, Sequence, Tuple

from edge_runtime.util import UserError

if TYPE_CHECKING:
    from edge_runtime.tls import TlsFiles

_TIMEOUT_S = 1.0
# A server that refuses a client's certificate says so after the handshake (TLS 1.3).
_ALERT_S = 0.3
_AUTHORITY = "both need one authority, and certificates that have not expired"


def why_no_link(endpoint: str, files: Optional[TlsFiles]) -> str:
    """Why there is no link, on one line; empty where nothing speaks against it.

    Takes up to 1.3 s for each address of the host, and as long as the name server does.
    """
    return why_unreachable(endpoint) or why_refused(endpoint, files)


def why_nobody_answers(endpoint: str, files: Optional[TlsFiles]) -> str:
    """Why a client that must have a link at once gets none, on one line."""
    why = why_unreachable(endpoint)
    refusal = "" if why else why_refused(endpoint, files)
    if endpoint.startswith("quic/"):  # such a link does not say why it fails
        why = why or "or one end does not believe the other's certificate"
    return refusal or (
        f"nobody answers at {endpoint}{why and f': {why}'}; start the simulator first, or name its"
        " address with --connect"
    )


def _addresses(endpoint: str) -> List[Any]:
    """What `socket.getaddrinfo` gives for an endpoint; OSError where it cannot be resolved."""
    protocol, host, port = _parts(endpoint)
    try:
        return socket.getaddrinfo(host, port, type=_kind(protocol))
    except UnicodeError as error:  # no host can have such a name
        raise OSError(None, str(error)) from None


def why_unreachable(endpoint: str) -> str:
    """Why nobody answers at that address, on one line; empty where somebody does."""
    protocol, host, port = _parts(endpoint)
    try:
        _addresses(endpoint)
    except OSError as error:
        return f"host {host!r} cannot be resolved ({error.strerror})"
    if protocol not in ("tcp", "tls"):
        return ""
    try:
        socket.create_connection((host, port), timeout=_TIMEOUT_S).close()
    except ConnectionRefusedError:
        return f"nobody listens on port {port} of {host} (connection refused)"
    except socket.timeout:
        return f"{host} does not answer within {_TIMEOUT_S:.0f} s"
    except OSError as error:
        return f"{host} cannot be reached ({error.strerror})"
    return ""


def why_refused(endpoint: str, files: Optional[TlsFiles]) -> str:
    """Why somebody who answers gives no link, on one line; empty where nobody does."""
    protocol, host, port = _parts(endpoint)
    if protocol not in ("tcp", "tls"):
        return ""
    try:
        plain = socket.create_connection((host, port), timeout=_TIMEOUT_S)
    except (OSError, UnicodeError):
        return ""
    with contextlib.closing(plain):
        if files is None:
            return _why_not_plain(plain, endpoint)
        return _why_not_tls(plain, endpoint, host, files)


def check_ports_are_free(endpoints: Sequence[str]) -> None:
    """Raise UserError for one that cannot be had: Zenoh names neither the port nor the cause."""
    for endpoint in endpoints:
        _, host, port = _parts(endpoint)
        try:
            family, kind, _, _, target = _addresses(endpoint)[0]
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


def _why_not_plain(plain: socket.socket, endpoint: str) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(plain).close()
        speaks_tls = True
    except ssl.SSLError as error:
        speaks_tls = "ALERT" in (error.reason or "")
    except OSError:
        speaks_tls = False
    if speaks_tls:
        return f"{endpoint} listens with TLS and wants --tls, with tls/ for tcp/"
    return f"{endpoint} answers, but not as a simulator or a router does"


def _why_not_tls(plain: socket.socket, endpoint: str, host: str, files: TlsFiles) -> str:
    context = ssl.create_default_context(cafile=files.ca)
    context.load_cert_chain(files.certificate, files.key)
    shaken = False
    try:
        with context.wrap_socket(plain, server_hostname=host) as link:
            shaken = True
            link.settimeout(_ALERT_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint} shows a certificate that is not believed here: {error.verify_message}"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        if "alert" in reason:
            return f"{endpoint} refuses the certificate of {files.name} ({reason}): {_AUTHORITY}"
        return f"{endpoint} does not speak TLS ({reason})"
    except OSError:  # A link that stays open, and silent, has been accepted.
        return "" if shaken else f"{endpoint} answers, but not with TLS"
    return ""
