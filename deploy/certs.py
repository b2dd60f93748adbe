"""``python -m deploy certs``: an authority of one's own, and a certificate for each party.

The common name of a certificate says which party it is; `edge_runtime.tls` says what each party
may send and hear. Only the certificates of parties that listen may act as servers, so no viewer
or operator can pose as a simulator. Each party gets a folder with the three files that it needs.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import ipaddress
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from edge_runtime.cli import examples, whole_number
from edge_runtime.files import write_atomic
from edge_runtime.tls import (
    CA_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    ROLES,
    common_name,
    read_private_key,
)
from edge_runtime.util import UserError, read_bytes
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

CA_FOLDER = "ca"
CA_KEY_FILE = "ca.key.pem"
CA_DAYS = 3650
DEFAULT_OUT = "certs"
DEFAULT_DAYS = 365
CLOCK_SLACK = datetime.timedelta(days=1)
"""A certificate is valid from a day ago: boards' clocks are behind until they are set."""
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")
MAX_NAME_CHARS = 64
"""Of a certificate's common name (RFC 5280)."""
_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST_NAME = re.compile(rf"(?=.{{1,253}}$){_LABEL}(\.{_LABEL})*")

EXAMPLE = examples(
    "python -m deploy certs --vehicle-id hunter01 --host workstation.local --out certs",
)


class Pair(NamedTuple):
    """A certificate and its private key: a party's, or the authority's that makes others."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out", metavar="DIR", default=DEFAULT_OUT, help="directory of all folders"
    )
    parser.add_argument(
        "--vehicle-id",
        metavar="ID",
        action="append",
        help="a vehicle to make edge-ID, simulator-ID and operator-ID for; may be repeated"
        f" (default: {DEFAULT_VEHICLE_ID})",
    )
    parser.add_argument(
        "--host",
        metavar="NAME",
        action="append",
        default=[],
        help="a name or address at which simulator or router are reached; may be repeated"
        f" (always: {', '.join(LOOPBACK_HOSTS)})",
    )
    parser.add_argument(
        "--days",
        metavar="N",
        type=whole_number(1, CA_DAYS),
        default=DEFAULT_DAYS,
        help="how long they are valid, days",
    )


def run(arguments: argparse.Namespace) -> int:
    """Make what is missing of the authority and of the parties' folders.

    Raises UserError, with nothing written, where nothing is missing.
    """
    out, days = Path(arguments.out), arguments.days
    hosts = [*LOOPBACK_HOSTS, *map(_check_host, arguments.host)]
    roles = _missing(out, _check_parties(arguments.vehicle_id or [DEFAULT_VEHICLE_ID]))
    now = datetime.datetime.now(datetime.UTC)
    ca_folder = out / CA_FOLDER
    is_new = not ca_folder.exists()
    authority = make_authority(now) if is_new else read_authority(ca_folder)
    left = authority.certificate.not_valid_after_utc - now
    if left < datetime.timedelta(days=days):
        raise UserError(f"--days {days} is longer than the authority's own {left.days} days")
    if is_new:
        _write_folder(ca_folder, authority, {CA_KEY_FILE: _pem(authority.key)})
    for name, role in roles.items():
        issued = issue(authority, name, role, hosts, now, days)
        files = {CERTIFICATE_FILE: _pem(issued.certificate), KEY_FILE: _pem(issued.key)}
        _write_folder(out / name, authority, files)
    print(f"authority (keep {ca_folder / CA_KEY_FILE} off every board): {ca_folder}")
    for name in roles:
        print(f"--tls {out / name}")
    print(f"valid until {now + datetime.timedelta(days=days):%Y-%m-%d}")
    return 0


def _check_parties(vehicle_ids: list[str]) -> dict[str, str]:
    """The role of each party of these vehicles, by name; UserError for ids that name none."""
    roles = party_roles(map(check_vehicle_id, vehicle_ids))
    for name in roles:
        if len(name) > MAX_NAME_CHARS:
            raise UserError(
                f"no certificate can name {name}: its {len(name)} characters are over"
                f" {MAX_NAME_CHARS}; choose a shorter --vehicle-id"
            )
    return roles


def _check_host(text: str) -> str:
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(text))
    if _HOST_NAME.fullmatch(text) is None:
        raise UserError(f"host {text!r} is not valid: write a name or an address, without port")
    return text


def _missing(out: Path, roles: dict[str, str]) -> dict[str, str]:
    """Those that have no folder yet; UserError where all have one."""
    missing = {name: role for name, role in roles.items() if not (out / name).exists()}
    if not missing:
        raise UserError(
            f"{out} has {', '.join(roles)} already and nothing is overwritten; move away"
            " what is to be made new, or choose another --vehicle-id or --out"
        )
    for name in sorted(roles.keys() - missing.keys()):
        print(f"kept as it is: {out / name}")
    return missing


def _write_folder(folder: Path, authority: Pair, files: dict[str, bytes]) -> None:
    """Fill a draft beside it and move it there, so that the folder is whole or absent.

    It is the owner's alone, and so are the keys in it, from the first moment on.
    """
    draft = folder.with_name(f".{folder.name}.{os.getpid()}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft.mkdir(mode=0o700)
        for name, data in {CA_FILE: _pem(authority.certificate), **files}.items():
            write_atomic(draft / name, data)
            if name in (KEY_FILE, CA_KEY_FILE):
                (draft / name).chmod(0o600)
        draft.rename(folder)  # Fails where somebody has filled it meanwhile.
    except OSError as error:
        raise UserError(f"cannot create {folder}: {error.strerror}") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _pem(each: x509.Certificate | ec.EllipticCurvePrivateKey) -> bytes:
    if isinstance(each, x509.Certificate):
        return each.public_bytes(Encoding.PEM)
    return each.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def make_authority(now: datetime.datetime, days: int = CA_DAYS) -> Pair:
    """A new authority that may issue certificates of parties and no further authorities."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("PHIL-TD3 hardware-in-the-loop authority")
    builder = (
        _builder(name, name, key, now, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    return Pair(builder.sign(key, hashes.SHA256()), key)


def read_authority(folder: Path) -> Pair:
    """The authority that `make_authority` made before. UserError where its files do not fit."""
    pem = read_bytes(folder / CA_FILE, "authority")
    try:
        certificate = x509.load_pem_x509_certificate(pem)
    except ValueError:
        raise UserError(f"{folder / CA_FILE} is not a certificate in PEM") from None
    key = read_private_key(folder / CA_KEY_FILE)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UserError(f"{folder / CA_KEY_FILE} is not a key of an elliptic curve")
    if key.public_key() != certificate.public_key():
        raise UserError(f"{folder / CA_KEY_FILE} does not fit {CA_FILE} beside it")
    return Pair(certificate, key)


def party_roles(vehicle_ids: Iterable[str]) -> dict[str, str]:
    """Return the role of each party by its common name: those of all vehicles first."""
    shared = {role: role for role, rights in ROLES.items() if rights.all_vehicles}
    own = [role for role, rights in ROLES.items() if not rights.all_vehicles]
    return shared | {common_name(role, i): role for i in vehicle_ids for role in own}


def issue(
    authority: Pair,
    party: str,
    role: str,
    hosts: Iterable[str],
    now: datetime.datetime,
    days: int,
) -> Pair:
    """A certificate for a party; ``hosts`` are the names under which a listener is reached."""
    key = ec.generate_private_key(ec.SECP256R1())
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = _builder(_name(party), authority.certificate.subject, key, now, days)
    if ROLES[role].listens:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = x509.SubjectAlternativeName([_host(host) for host in dict.fromkeys(hosts)])
        builder = builder.add_extension(names, critical=False)
    builder = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
    )
    return Pair(builder.sign(authority.key, hashes.SHA256()), key)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    now: datetime.datetime,
    days: int,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SLACK)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
