"""The three files with which a party shows who it is: `ca.pem`, `cert.pem`, `key.pem`.

All of them are read and held against one another before a session is opened, because Zenoh's own
message for any fault in them is "Unable to connect".
"""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import Any, Dict, NamedTuple, Optional

from edge_runtime.errors import UserError
from edge_runtime.files import PathLike, read_bytes
from edge_runtime.private_keys import read_private_key

CA_FILE, CERTIFICATE_FILE, KEY_FILE = "ca.pem", "cert.pem", "key.pem"
TLS_PROTOCOLS = ("tls", "quic")

# Nothing for others, and no writing for the group. A group may read: systemd hands a service its
# credentials so.
_OPEN_MODE = 0o027


class TlsFiles(NamedTuple):
    """A party's files, checked. The directory is what `--tls` names."""

    directory: Path
    name: str
    """The certificate's common name, as in `edge-hunter01`: what access control goes by."""
    expires: datetime.datetime
    """UTC."""

    @property
    def ca(self) -> str:
        """The authority whose certificates this party believes."""
        return str(self.directory / CA_FILE)

    @property
    def certificate(self) -> str:
        """The certificate that shows who this party is."""
        return str(self.directory / CERTIFICATE_FILE)

    @property
    def key(self) -> str:
        """The private key of that certificate."""
        return str(self.directory / KEY_FILE)


def is_tls(endpoint: str) -> bool:
    """Is it an endpoint of a protocol that asks for certificates?"""
    return endpoint.split("/", 1)[0] in TLS_PROTOCOLS


def tls_for(directory: Optional[PathLike], *endpoints: Optional[str]) -> Optional[TlsFiles]:
    """The files of `--tls DIR`, None without it; UserError where endpoints do not go with that."""
    for endpoint in endpoints:
        if endpoint is not None:
            check_fits(endpoint, directory is not None)
    return None if directory is None else load_tls(directory)


def check_fits(endpoint: str, with_tls: bool) -> None:
    """Raise UserError for a TLS endpoint without files, and for files with a plain endpoint."""
    address = endpoint.split("/", 1)[1]
    if with_tls and not is_tls(endpoint):
        raise UserError(
            f"endpoint {endpoint} would send plain text despite --tls: write tls/{address}"
        )
    if not with_tls and is_tls(endpoint):
        raise UserError(
            f"endpoint {endpoint} needs certificates: name a directory of"
            " `python -m deploy certs` with --tls"
        )


def load_tls(directory: PathLike) -> TlsFiles:
    """Check the three files against one another and the clock.

    Raises UserError for a file that is missing or no PEM, a key that others can read or that is
    another certificate's, a certificate of another authority, expired, or not valid yet.
    """
    from cryptography import x509  # Only who uses TLS pays for it, in memory and at the start.

    folder = Path(os.path.abspath(directory))  # Zenoh opens the files later.
    if not folder.is_dir():
        raise UserError(f"--tls {directory} is no directory; `python -m deploy certs` makes one")
    ca = _certificate(folder / CA_FILE, x509)
    certificate = _certificate(folder / CERTIFICATE_FILE, x509)
    _check_key(folder / KEY_FILE, certificate)
    _check_issuer(folder, certificate, ca)
    for path, each in ((folder / CERTIFICATE_FILE, certificate), (folder / CA_FILE, ca)):
        _check_dates(path, each)
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    name = str(names[0].value) if names else ""
    return TlsFiles(folder, name, _utc(certificate, "not_valid_after"))


def zenoh_rows(files: TlsFiles) -> Dict[str, Any]:
    """Zenoh's `transport/link/tls`: mutual, names verified, links closed when they expire."""
    return {
        "root_ca_certificate": files.ca,
        "listen_private_key": files.key,
        "listen_certificate": files.certificate,
        "connect_private_key": files.key,
        "connect_certificate": files.certificate,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def _certificate(path: Path, x509: Any) -> Any:
    data = read_bytes(path, "certificate")
    try:
        return x509.load_pem_x509_certificate(data)
    except ValueError:
        raise UserError(f"{path} is not a certificate in PEM") from None


def _check_key(path: Path, certificate: Any) -> None:
    key = read_private_key(path)
    if path.stat().st_mode & _OPEN_MODE:
        raise UserError(f"private key {path} is open to others; close it: chmod 600 {path}")
    if key.public_key() != certificate.public_key():
        raise UserError(f"private key {path} does not fit {CERTIFICATE_FILE} beside it")


def _check_issuer(folder: Path, certificate: Any, ca: Any) -> None:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        raise UserError(
            f"{folder / CERTIFICATE_FILE} was not issued by the authority in {CA_FILE} beside it"
        ) from None


def _check_dates(path: Path, certificate: Any) -> None:
    now = datetime.datetime.now(datetime.timezone.utc)
    begins, ends = _utc(certificate, "not_valid_before"), _utc(certificate, "not_valid_after")
    if now >= ends:
        raise UserError(f"{path} expired at {ends:%Y-%m-%d %H:%M} UTC; make a new one")
    if now < begins:
        raise UserError(
            f"{path} is valid from {begins:%Y-%m-%d %H:%M} UTC on, and the clock here says"
            f" {now:%Y-%m-%d %H:%M} UTC; is the clock set?"
        )


def _utc(certificate: Any, field: str) -> datetime.datetime:
    """The date with its time zone; cryptography before 42 has it without one only."""
    aware: Optional[datetime.datetime] = getattr(certificate, f"{field}_utc", None)
    if aware is None:
        aware = getattr(certificate, field).replace(tzinfo=datetime.timezone.utc)
    return aware
