"""Why a TLS link does not come about: one handshake with the same files, by Python's own ssl.

Zenoh says "Unable to connect" whether nobody is there, the other end refuses us, or we refuse it.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
from typing import Optional

from edge_runtime.tls import TlsFiles

_TIMEOUT_S = 1.0
# A server that refuses a client's certificate says so after the handshake (TLS 1.3).
_ALERT_S = 0.3
_AUTHORITY = "both need one authority, and certificates that have not expired"


def why_refused(endpoint: str, files: TlsFiles) -> Optional[str]:
    """Why no link comes about, on one line; None where nobody answers or nothing is wrong.

    Takes up to 1.3 s. An endpoint of quic is not tried: Python has no QUIC.
    """
    protocol, address = endpoint.split("/", 1)
    if protocol != "tls":
        return None
    host, port = address.rsplit(":", 1)
    host = host.strip("[]")
    context = ssl.create_default_context(cafile=files.ca)
    context.load_cert_chain(files.certificate, files.key)
    try:
        plain = socket.create_connection((host, int(port)), timeout=_TIMEOUT_S)
    except OSError:
        return None
    with contextlib.closing(plain):
        return _shake_hands(plain, context, host, endpoint, files)


def _shake_hands(
    plain: socket.socket, context: ssl.SSLContext, host: str, endpoint: str, files: TlsFiles
) -> Optional[str]:
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
        return None if shaken else f"{endpoint} answers, but not with TLS"
    return None
