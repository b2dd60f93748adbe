"""``python -m deploy certs``: an authority of one's own, and a certificate for each party.

The common name of a certificate says which party it is; `edge_runtime.access` says what each party
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
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from edge_runtime.access import ROLES, common_name
from edge_runtime.cli import examples
from edge_runtime.errors import UserError
from edge_runtime.files import read_bytes, write_atomic
from edge_runtime.option_types import whole_number
from edge_runtime.private_keys import read_private_key
from edge_runtime.tls import CA_FILE, CERTIFICATE_FILE, KEY_FILE
from edge_runtime.topics import DEFAULT_VEHICLE_ID, check_vehicle_id

CA_KEY_FILE = "ca.key.pem"
CA_DAYS = 3650
CLOCK_SLACK = datetime.timedelta(days=1)
"""A certificate is valid from a day ago: boards' clocks are behind until they are set."""
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")


class Authority(NamedTuple):
    """The certificate that everybody believes, and the key that makes others."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


class Issued(NamedTuple):
    """A party's own pair."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_authority(now: datetime.datetime, days: int = CA_DAYS) -> Authority:
    """A new authority that may issue certificates of parties and no further authorities."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("PHIL-TD3 hardware-in-the-loop authority")
    builder = (
        _builder(name, name, key, now, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    return Authority(builder.sign(key, hashes.SHA256()), key)


def read_authority(folder: Path) -> Authority:
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
    return Authority(certificate, key)


def party_roles(vehicle_ids: Iterable[str]) -> dict[str, str]:
    """Return the role of each party by its common name: those of all vehicles first."""
    shared = {role: role for role, rights in ROLES.items() if rights.all_vehicles}
    own = [role for role, rights in ROLES.items() if not rights.all_vehicles]
    return shared | {common_name(role, i): role for i in vehicle_ids for role in own}


def issue(
    authority: Authority,
    party: str,
    role: str,
    hosts: Iterable[str],
    now: datetime.datetime,
    days: int,
) -> Issued:
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
    return Issued(builder.sign(authority.key, hashes.SHA256()), key)


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


CA_FOLDER = "ca"
DEFAULT_OUT = "certs"
DEFAULT_DAYS = 365
MAX_NAME_CHARS = 64
"""Of a certificate's common name (RFC 5280)."""
_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST_NAME = re.compile(rf"(?=.{{1,253}}$){_LABEL}(\.{_LABEL})*")


class Request(NamedTuple):
    """What the command line asks for, checked."""

    out: Path
    vehicle_ids: list[str]
    hosts: list[str]
    days: int


EXAMPLE = examples(
    "python -m deploy certs --vehicle-id hunter01 --host workstation.local --out certs",
)


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


def certs(arguments: argparse.Namespace) -> int:
    """Make what is missing of the authority and of the parties' folders.

    Raises UserError, with nothing written, where nothing is missing.
    """
    request = _check(arguments)
    roles = _missing(request)
    now = datetime.datetime.now(datetime.UTC)
    ca_folder = request.out / CA_FOLDER
    is_new = not ca_folder.exists()
    authority = make_authority(now) if is_new else read_authority(ca_folder)
    _check_lifetime(authority, now, request.days)
    if is_new:
        with _new_folder(ca_folder) as draft:
            write_atomic(draft / CA_FILE, _pem(authority.certificate))
            _write_key(draft / CA_KEY_FILE, authority.key)
    for name, role in roles.items():
        issued = issue(authority, name, role, request.hosts, now, request.days)
        with _new_folder(request.out / name) as draft:
            write_atomic(draft / CA_FILE, _pem(authority.certificate))
            write_atomic(draft / CERTIFICATE_FILE, _pem(issued.certificate))
            _write_key(draft / KEY_FILE, issued.key)
    print(f"authority (keep {ca_folder / CA_KEY_FILE} off every board): {ca_folder}")
    for name in roles:
        print(f"--tls {request.out / name}")
    print(f"valid until {now + datetime.timedelta(days=request.days):%Y-%m-%d}")
    return 0


def _check(arguments: argparse.Namespace) -> Request:
    vehicle_ids = arguments.vehicle_id or [DEFAULT_VEHICLE_ID]
    for vehicle_id in vehicle_ids:
        check_vehicle_id(vehicle_id)
    for name in party_roles(vehicle_ids):
        if len(name) > MAX_NAME_CHARS:
            raise UserError(
                f"no certificate can name {name}: its {len(name)} characters are over"
                f" {MAX_NAME_CHARS}; choose a shorter --vehicle-id"
            )
    for host in arguments.host:
        if not _is_host(host):
            raise UserError(f"host {host!r} is not valid: write a name or an address, without port")
    hosts = [*LOOPBACK_HOSTS, *arguments.host]
    return Request(Path(arguments.out), list(dict.fromkeys(vehicle_ids)), hosts, arguments.days)


def _is_host(text: str) -> bool:
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(text)
        return True
    return _HOST_NAME.fullmatch(text) is not None


def _missing(request: Request) -> dict[str, str]:
    """The role of each party that has no folder yet, by name; UserError where all have one."""
    roles = party_roles(request.vehicle_ids)
    missing = {name: role for name, role in roles.items() if not (request.out / name).exists()}
    if not missing:
        raise UserError(
            f"{request.out} has {', '.join(roles)} already and nothing is overwritten; move away"
            " what is to be made new, or choose another --vehicle-id or --out"
        )
    for name in sorted(roles.keys() - missing.keys()):
        print(f"kept as it is: {request.out / name}")
    return missing


def _check_lifetime(authority: Authority, now: datetime.datetime, days: int) -> None:
    left = authority.certificate.not_valid_after_utc - now
    if left < datetime.timedelta(days=days):
        raise UserError(f"--days {days} is longer than the authority's own {left.days} days")


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Fill a draft beside it and move it there, so that the folder is whole or absent."""
    draft = folder.with_name(f".{folder.name}.{os.getpid()}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft.mkdir(mode=0o700)
        yield draft
        draft.rename(folder)  # Fails where somebody has filled it meanwhile.
    except OSError as error:
        raise UserError(f"cannot create {folder}: {error.strerror}") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """PKCS8 PEM, mode 0600. The folder is the owner's alone, so it never was open to others."""
    write_atomic(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    path.chmod(0o600)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)
