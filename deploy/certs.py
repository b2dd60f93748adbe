"""``python -m deploy keys`` and ``certs``: make signing keys and TLS certificates.

A certificate's common name is its party; `edge_runtime.tls` holds the rights of each party. Only
parties that listen get a server's certificate: no viewer can pose as a simulator.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import ipaddress
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives import serialization as form
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from edge_runtime import tls
from edge_runtime.cli import command, whole_number
from edge_runtime.files import draft_of, write_atomic
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, read_bytes
from edge_runtime.wire import DEFAULT_VEHICLE_ID

DEFAULT_KEY = str(DEFAULT_PUBLIC_KEY.with_suffix(".key"))
CA_KEY_FILE = "ca.key.pem"
CA_DAYS = 3650
CLOCK_SLACK = datetime.timedelta(days=1)
"""A certificate is valid from a day ago: boards' clocks are behind until they are set."""
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")
_PEM = form.Encoding.PEM


@command("deploy.certs:run_keys", "python -m deploy keys --out keys")
def keys(parser: argparse.ArgumentParser) -> None:
    text = "folder for policy.key and policy.pub"
    parser.add_argument("--out", metavar="DIR", default=str(DEFAULT_PUBLIC_KEY.parent), help=text)


def run_keys(arguments: argparse.Namespace) -> int:
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


def write_key_pair(directory: Path) -> tuple[Path, Path]:
    """Write `policy.key`, readable by its owner only, and `policy.pub`; UserError if one exists."""
    public_path = directory / DEFAULT_PUBLIC_KEY.name
    private_path = public_path.with_suffix(".key")
    if private_path.exists() or public_path.exists():
        raise UserError(f"{directory} holds a key, which is not overwritten; choose another --out")
    key = ed25519.Ed25519PrivateKey.generate()
    write_private(private_path, _pem(key))
    public = key.public_key().public_bytes(_PEM, form.PublicFormat.SubjectPublicKeyInfo)
    write_atomic(public_path, public)
    return private_path, public_path


def write_private(path: Path, data: bytes) -> None:
    """Write a file that others can never read: by the umask, because a chmod comes too late."""
    before = os.umask(0o077)
    try:
        write_atomic(path, data)
    finally:
        os.umask(before)


class CertificatePair(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


@command(
    "deploy.certs:run_certs",
    "python -m deploy certs --vehicle-id hunter01 --host workstation.local --out certs",
)
def certs(parser: argparse.ArgumentParser) -> None:
    vehicle = f"vehicle to make parties for; may be repeated (default: {DEFAULT_VEHICLE_ID})"
    host = "name or address of the simulator or router beside loopback's; may be repeated"
    add, days = parser.add_argument, whole_number(1, CA_DAYS)
    add("--out", metavar="DIR", default="certs", help="folder for the parties' folders")
    add("--vehicle-id", metavar="ID", action="append", help=vehicle)
    add("--host", metavar="NAME", action="append", default=[], help=host)
    add("--days", metavar="N", type=days, default=365, help="lifetime of the certificates, days")


def run_certs(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    hosts = list(dict.fromkeys(map(_host, [*LOOPBACK_HOSTS, *arguments.host])))
    parties = {
        tls.common_name(role, None if rights.all_vehicles else vehicle_id): role
        for role, rights in tls.ROLES.items()
        for vehicle_id in arguments.vehicle_id or [DEFAULT_VEHICLE_ID]
    }
    if max(map(len, parties)) > 64:  # The longest common name of a certificate (RFC 5280)
        raise UserError("no certificate can name this vehicle: choose a shorter --vehicle-id")
    missing = {name: role for name, role in parties.items() if not (out / name).exists()}
    if not missing:
        raise UserError(f"{out} has {', '.join(parties)} already, and nothing is overwritten")
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)  # As certificates have it
    ca_folder = out / "ca"
    if ca_folder.exists():
        authority = read_authority(ca_folder)
    else:
        authority = issue(None, "PHIL-TD3 hardware-in-the-loop authority", "", (), now, CA_DAYS)
        _write_folder(ca_folder, authority, {CA_KEY_FILE: _pem(authority.key)})
    days = min(arguments.days, (authority.certificate.not_valid_after_utc - now).days)
    if days < 1:
        raise UserError(f"the authority in {ca_folder} has expired: make another in a new --out")
    for name, role in missing.items():
        issued = issue(authority, name, role, hosts, now, days)
        certificate = issued.certificate.public_bytes(_PEM)
        files = {tls.CERTIFICATE_FILE: certificate, tls.KEY_FILE: _pem(issued.key)}
        _write_folder(out / name, authority, files)
    print(f"authority (keep {ca_folder / CA_KEY_FILE} off every board): {ca_folder}")
    for name in missing:
        print(f"--tls {out / name}")
    print(f"valid until {now + datetime.timedelta(days=days):%Y-%m-%d}")
    return 0


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        if re.fullmatch(r"[A-Za-z0-9.-]+", text):
            return x509.DNSName(text)
    raise UserError(f"host {text!r} is not valid: write a name or an address, without port")


def _write_folder(folder: Path, authority: CertificatePair, files: dict[str, bytes]) -> None:
    """Fill a private draft and rename it, so that the folder is whole or absent."""
    with draft_of(folder) as draft:
        draft.mkdir(mode=0o700)
        write_atomic(draft / tls.CA_FILE, authority.certificate.public_bytes(_PEM))
        for name, data in files.items():
            write_private(draft / name, data)


def _pem(key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey) -> bytes:
    return key.private_bytes(_PEM, form.PrivateFormat.PKCS8, form.NoEncryption())


def read_authority(folder: Path) -> CertificatePair:
    pem = read_bytes(folder / tls.CA_FILE, "authority")
    key = tls.read_private_key(folder / CA_KEY_FILE)
    with contextlib.suppress(ValueError):
        certificate = x509.load_pem_x509_certificate(pem)
        if key.public_key() == certificate.public_key():
            return CertificatePair(certificate, key)
    raise UserError(f"{folder} holds no {tls.CA_FILE} with its {CA_KEY_FILE}")


def issue(
    authority: CertificatePair | None,
    party: str,
    role: str,
    hosts: Sequence[x509.GeneralName],
    now: datetime.datetime,
    days: int,
) -> CertificatePair:
    """Make a party's key and certificate; without an authority, those of an authority."""
    key, is_authority = ec.generate_private_key(ec.SECP256R1()), authority is None
    uses: dict[str, Any] = {
        "digital_signature": not is_authority, "key_cert_sign": is_authority,
        "crl_sign": is_authority, "content_commitment": False, "key_encipherment": False,
        "data_encipherment": False, "key_agreement": False, "encipher_only": False,
        "decipher_only": False,
    }  # fmt: skip
    # Extension, and whether it is critical: a reader that does not know it must refuse.
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.BasicConstraints(ca=is_authority, path_length=0 if is_authority else None), True),
        (x509.KeyUsage(**uses), True),
        (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False),
    ]
    if authority:
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if tls.ROLES[role].listens:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            extensions.append((x509.SubjectAlternativeName(hosts), False))
        issuer_key = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
        extensions += [(x509.ExtendedKeyUsage(purposes), False), (issuer_key, False)]
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, party)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(authority.certificate.subject if authority else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SLACK)
        .not_valid_after(now + datetime.timedelta(days=days))
    )
    for extension, is_critical in extensions:
        builder = builder.add_extension(extension, is_critical)
    signed = builder.sign(authority.key if authority else key, hashes.SHA256())
    return CertificatePair(signed, key)
