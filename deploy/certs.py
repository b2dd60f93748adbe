"""An authority of one's own, and a certificate for each party on the wire.

Who is who goes by the common name; what a name may say and hear is `edge_runtime.tls`.
Only listeners' certificates are servers', so that no viewer or operator can pose as a simulator.
"""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from edge_runtime.tls import CA_FILE, ROLES, common_name, read_private_key
from edge_runtime.util import UserError, read_bytes

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
