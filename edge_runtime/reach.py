"""Explain a missing link, watch the far end's certificate, find a free port (socket and ssl)."""

from __future__ import annotations

import contextlib
import math
import socket
import ssl
from collections import deque
from typing import Any, Deque, Optional, Tuple

from edge_runtime.tls import TlsFiles
from edge_runtime.wire import Reason, Rejection

_LOOK_S = 1.0
# A server that refuses a client's certificate says so after the handshake (TLS 1.3).
_ALERT_S = 0.3
_KEPT: Deque[socket.socket] = deque(maxlen=100)  # a long campaign would run out of open files


def why_no_link(endpoint: str, files: Optional[TlsFiles]) -> Tuple[bool, str]:
    """Return whether anybody answers at `endpoint`, and why there is no link; "" if there is."""
    protocol, host, port = _parts(endpoint)
    answers = False
    try:
        if protocol != "udp":
            with socket.create_connection((host, port), timeout=_LOOK_S) as plain:
                answers = True
                if files is not None:
                    _shake_hands(plain, host, files)
    except (OSError, UnicodeError) as error:  # UnicodeError: no host can have such a name
        return answers, str(error)
    return answers, ""


def _shake_hands(plain: socket.socket, host: str, files: TlsFiles) -> None:
    with _context(files).wrap_socket(plain, server_hostname=host) as link:
        link.settimeout(_ALERT_S)
        with contextlib.suppress(socket.timeout):  # no alert: the server accepts us
            link.recv(1)


def _context(files: TlsFiles) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # verifies, no more strictly than Zenoh does
    context.load_verify_locations(files.ca)
    context.load_cert_chain(files.certificate, files.key)
    return context


class Listener:
    """The far end of a TLS link: until when its certificate and our own are valid.

    Zenoh closes a link whose certificate expires, and lets a new one in before the second is over.
    """

    def __init__(self, endpoint: str, files: TlsFiles) -> None:
        self._endpoint, self._files, self.own_until_s = endpoint, files, files.expires.timestamp()
        self._until_s, self._why = -math.inf, "has not been seen yet"
        self.look()

    def refusal(self, now_s: float) -> Optional[Rejection]:
        """Return why states are refused at this Unix time; None while both certificates hold."""
        if now_s >= self.own_until_s:
            return Rejection(Reason.CERTIFICATE, f"our own, of {self._files.name}, has expired")
        if now_s >= self._until_s:
            return Rejection(Reason.CERTIFICATE, f"that of {self._endpoint} {self._why}")
        return None

    def look(self) -> None:
        """Read the listener's certificate; keep the last one if the listener is not reached."""
        _, host, port = _parts(self._endpoint)
        try:
            plain = socket.create_connection((host, port), timeout=_LOOK_S)
            with plain, _context(self._files).wrap_socket(plain, server_hostname=host) as link:
                shown: Any = link.getpeercert()
        except ssl.SSLCertVerificationError as error:
            self._until_s, self._why = -math.inf, f"is not believed here: {error.verify_message}"
        except OSError:
            pass
        else:
            self._until_s = ssl.cert_time_to_seconds(shown["notAfter"])
            self._why = f"expired at {shown['notAfter']}"


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a free endpoint on loopback, and reserve it: for demos and tests."""
    probe = socket.socket()
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a server can still listen there
    probe.bind(("127.0.0.1", 0))
    _KEPT.append(probe)
    return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def _parts(endpoint: str) -> Tuple[str, str, int]:
    protocol, address = endpoint.split("/", 1)
    host, port = address.rsplit(":", 1)
    return protocol, host.strip("[]"), int(port)
