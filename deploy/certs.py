"""``python -m deploy keys, certs, router``: who may sign, and who may talk to whom.

An Ed25519 pair signs policies and bundles. The owner's authority makes a TLS certificate for each
party. Its common name says which party it is, and `edge_runtime.tls` says what each party may send
and hear. Only the certificates of parties that listen may act as servers, so no viewer or operator
can pose as a simulator. A fleet's router gets the same rights in one file for zenohd.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import ipaddress
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from edge_runtime import tls
from edge_runtime.cli import Subcommand, examples, whole_number
from edge_runtime.files import check_writable, make_directory, write_atomic, write_json
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, read_bytes
from edge_runtime.wire import DEFAULT_VEHICLE_ID, MAX_STATE_BYTES, check_vehicle_id

DEFAULT_KEY = str(DEFAULT_PUBLIC_KEY.with_suffix(".key"))
CA_KEY_FILE = "ca.key.pem"
CA_DAYS = 3650
CLOCK_SLACK = datetime.timedelta(days=1)
"""A certificate is valid from a day ago: boards' clocks are behind until they are set."""
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")
MAX_NAME_CHARS = 64  # The longest common name of a certificate (RFC 5280)
SESSIONS_PER_VEHICLE = 4
"""Edge runtime, simulator, an operator's command, and the edge runtime's look at its start."""
SPARE_SESSIONS = 1000  # Viewers; Zenoh's own default
MAX_MESSAGE_BYTES = 2 * MAX_STATE_BYTES
"""Twice what any edge runtime reads. Larger ones end at the router; Zenoh itself says 1 GiB."""
_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST_NAME = re.compile(rf"(?=.{{1,253}}$){_LABEL}(\.{_LABEL})*")
_KEY_USES = (
    *("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"),
    *("key_agreement", "key_cert_sign", "crl_sign", "encipher_only", "decipher_only"),
)


def _add_keys_arguments(parser: argparse.ArgumentParser) -> None:
    text = "folder for policy.key and policy.pub"
    parser.add_argument("--out", metavar="DIR", default=str(DEFAULT_PUBLIC_KEY.parent), help=text)


def _run_keys(arguments: argparse.Namespace) -> int:
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


def write_key_pair(directory: Path) -> tuple[Path, Path]:
    """Write `policy.key` (PKCS8 PEM, readable by the owner alone) and `policy.pub`.

    Raises UserError where a key is there already (it may have signed policies that drive), or the
    directory cannot be written.
    """
    public_path = directory / DEFAULT_PUBLIC_KEY.name
    private_path = public_path.with_suffix(".key")
    for path in (private_path, public_path):
        if path.exists():
            raise UserError(f"{path} exists and is not overwritten; choose another --out")
    make_directory(directory)
    key = ed25519.Ed25519PrivateKey.generate()
    write_private(private_path, _pem(key))
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    write_atomic(public_path, public)
    return private_path, public_path


def write_private(path: Path, data: bytes) -> None:
    """Write a file that others cannot read, not even briefly: the umask, not a chmod."""
    before = os.umask(0o077)
    try:
        write_atomic(path, data)
    finally:
        os.umask(before)


class CertificatePair(NamedTuple):
    """A certificate and its private key: a party's, or the authority's that makes others."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def _add_certs_arguments(parser: argparse.ArgumentParser) -> None:
    vehicle = "vehicle to make edge-ID, simulator-ID and operator-ID for; may be repeated"
    vehicle += f" (default: {DEFAULT_VEHICLE_ID})"
    host = "name or address at which the simulator or router is reached; may be repeated"
    host += f" (always: {', '.join(LOOPBACK_HOSTS)})"
    add, days = parser.add_argument, whole_number(1, CA_DAYS)
    add("--out", metavar="DIR", default="certs", help="folder for the parties' folders")
    add("--vehicle-id", metavar="ID", action="append", help=vehicle)
    add("--host", metavar="NAME", action="append", default=[], help=host)
    add("--days", metavar="N", type=days, default=365, help="lifetime of the certificates, days")


def _run_certs(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    hosts = list(dict.fromkeys(map(_host, [*LOOPBACK_HOSTS, *arguments.host])))
    parties = _missing(out, arguments.vehicle_id or [DEFAULT_VEHICLE_ID])
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)  # As certificates have it
    ca_folder = out / "ca"
    is_new = not ca_folder.exists()
    authority = make_authority(now) if is_new else read_authority(ca_folder)
    days = min(arguments.days, (authority.certificate.not_valid_after_utc - now).days)
    if is_new:
        _write_folder(ca_folder, authority, {CA_KEY_FILE: _pem(authority.key)})
    for name, role in parties.items():
        issued = issue(authority, name, role, hosts, now, days)
        certificate = issued.certificate.public_bytes(Encoding.PEM)
        files = {tls.CERTIFICATE_FILE: certificate, tls.KEY_FILE: _pem(issued.key)}
        _write_folder(out / name, authority, files)
    print(f"authority (keep {ca_folder / CA_KEY_FILE} off every board): {ca_folder}")
    for name in parties:
        print(f"--tls {out / name}")
    print(f"valid until {now + datetime.timedelta(days=days):%Y-%m-%d}")
    return 0


def _missing(out: Path, vehicle_ids: Sequence[str]) -> dict[str, str]:
    """The role of each party without a folder, by its name: those of all vehicles first.

    Raises UserError where all have one, and for an id that no certificate can name.
    """
    parties = {role: role for role, rights in tls.ROLES.items() if rights.all_vehicles}
    own = [role for role in tls.ROLES if role not in parties]
    parties |= {tls.common_name(role, vehicle): role for vehicle in vehicle_ids for role in own}
    if max(map(len, parties)) > MAX_NAME_CHARS:
        longest = max(parties, key=len)
        raise UserError(f"no certificate can name {longest}: choose a shorter --vehicle-id")
    missing = {name: role for name, role in parties.items() if not (out / name).exists()}
    if not missing:
        raise UserError(
            f"{out} has {', '.join(parties)} already and nothing is overwritten; move away"
            " what is to be made new, or choose another --vehicle-id or --out"
        )
    return missing


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        if _HOST_NAME.fullmatch(text):
            return x509.DNSName(text)
    raise UserError(f"host {text!r} is not valid: write a name or an address, without port")


def _write_folder(folder: Path, authority: CertificatePair, files: dict[str, bytes]) -> None:
    """Fill a draft beside it and move it there, so that the folder is whole or absent.

    It is the owner's alone, and so are the files in it, from the first moment on.
    """
    draft = folder.with_name(f".{folder.name}.{os.getpid()}")
    make_directory(folder.parent)
    try:
        draft.mkdir(mode=0o700)
        write_atomic(draft / tls.CA_FILE, authority.certificate.public_bytes(Encoding.PEM))
        for name, data in files.items():
            write_private(draft / name, data)
        draft.rename(folder)  # Fails where somebody has filled it meanwhile.
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _pem(key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def read_authority(folder: Path) -> CertificatePair:
    """Read the authority that was made before. Raises UserError where its files do not fit."""
    pem = read_bytes(folder / tls.CA_FILE, "authority")
    key = tls.read_private_key(folder / CA_KEY_FILE)
    try:
        certificate = x509.load_pem_x509_certificate(pem)
    except ValueError:
        raise UserError(f"{folder / tls.CA_FILE} is not a certificate in PEM") from None
    if key.public_key() != certificate.public_key():
        raise UserError(f"{folder / CA_KEY_FILE} does not fit {tls.CA_FILE} beside it")
    return CertificatePair(certificate, key)


def make_authority(now: datetime.datetime) -> CertificatePair:
    """Make an authority that may issue certificates of parties and no further authorities."""
    return issue(None, "PHIL-TD3 hardware-in-the-loop authority", "", (), now, CA_DAYS)


def issue(
    authority: CertificatePair | None,
    party: str,
    role: str,
    hosts: Sequence[x509.GeneralName],
    now: datetime.datetime,
    days: int,
) -> CertificatePair:
    """Make a party's key and certificate; without an authority, those of an authority.

    `hosts` are the names under which a party that listens is reached.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    uses = ("digital_signature",) if authority else ("key_cert_sign", "crl_sign")
    # Each with whether a reader that does not know it must refuse the certificate.
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.BasicConstraints(ca=not authority, path_length=None if authority else 0), True),
        (x509.KeyUsage(**{use: use in uses for use in _KEY_USES}), True),
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


def _add_router_arguments(parser: argparse.ArgumentParser) -> None:
    listen = "endpoint that all others connect to, such as tls/0.0.0.0:7447; may be repeated"
    files = "the router's folder of `deploy certs`, such as certs/router; zenohd opens its files"
    vehicle = "vehicle whose parties have rights at this router; may be repeated"
    add, append = parser.add_argument, functools.partial(parser.add_argument, action="append")
    append("--listen", metavar="tls/HOST:PORT", required=True, help=listen)
    add("--tls", metavar="DIR", required=True, help=files)
    append("--vehicle-id", metavar="ID", default=[], help=vehicle)
    add("--vehicles", metavar="FILE", help="file with one vehicle id a line; # begins a comment")
    add("--out", metavar="FILE.json5", required=True, help="file for the router's settings")


def _run_router(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    ids = list(arguments.vehicle_id)
    if arguments.vehicles:
        lines = read_bytes(arguments.vehicles, "file of vehicles").decode(errors="replace")
        ids += [word for line in lines.splitlines() if (word := line.partition("#")[0].strip())]
    if not ids:
        raise UserError("no vehicle: name each with --vehicle-id, or all of them in --vehicles")
    ids = list(dict.fromkeys(map(check_vehicle_id, ids)))
    write_json(arguments.out, _router_settings(arguments.listen, ids, arguments.tls))
    print(f"{arguments.out}: {len(ids)} vehicles")
    print(f"start it:  zenohd --config {arguments.out}")
    print(f"or:        python -m bridge router --config {arguments.out}")
    return 0


def _router_settings(listens: list[str], vehicle_ids: list[str], folder: str) -> dict[str, Any]:
    """Zenoh's settings as one nested map: those of `bridge router --tls`, and a fleet's limits.

    Raises UserError for plain endpoints and another party's certificate.
    """
    # Here: keys and certificates need no Zenoh.
    from edge_runtime.transport import check_endpoint, check_fits, session_rows

    for endpoint in listens:
        check_fits(check_endpoint(endpoint), with_tls=True)
    files = tls.load_tls(folder)
    tls.check_name(files.name, tls.ROUTER)
    rows = session_rows(listens, None, "router", files, tls.rules_for_listener(vehicle_ids))
    sessions = SPARE_SESSIONS + SESSIONS_PER_VEHICLE * len(vehicle_ids)
    rows["transport/unicast/max_sessions"] = sessions
    # After a router's restart all of its vehicles come at once.
    rows["transport/unicast/accept_pending"] = sessions
    rows["transport/link/rx/max_message_size"] = MAX_MESSAGE_BYTES
    nested: dict[str, Any] = {}
    for path, value in rows.items():
        place, (*folders, name) = nested, path.split("/")
        for each in folders:
            place = place.setdefault(each, {})
        place[name] = value
    return nested


KEYS = Subcommand(examples("python -m deploy keys --out keys"), _add_keys_arguments, _run_keys)
CERTS = Subcommand(
    examples("python -m deploy certs --vehicle-id hunter01 --host workstation.local --out certs"),
    _add_certs_arguments,
    _run_certs,
)
ROUTER_FILE = Subcommand(
    examples(
        "python -m deploy router --listen tls/0.0.0.0:7447 --tls certs/router \\\n"
        "    --vehicle-id hunter01 --vehicle-id hunter02 --out router.json5",
        "python -m deploy router --listen tls/0.0.0.0:7447 --tls certs/router"
        " --vehicles fleet.txt \\\n    --out router.json5",
    ),
    _add_router_arguments,
    _run_router,
)
