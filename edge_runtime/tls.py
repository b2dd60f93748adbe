"""Certificates, private keys, and each party's rights on the wire.

The files are checked before a session is opened: Zenoh says only "Unable to connect". ROLES is the
table of rights, by the certificate's common name. Zenoh filters silently, and only in the process
that holds the rules: the simulator or router that listens, and each edge runtime.
"""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from edge_runtime.util import PathLike, UserError, read_bytes
from edge_runtime.wire import check_vehicle_id

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

CA_FILE, CERTIFICATE_FILE, KEY_FILE = "ca.pem", "cert.pem", "key.pem"


class TlsFiles(NamedTuple):
    """A party's three files, checked, as paths."""

    ca: str
    certificate: str
    key: str
    name: str  # the certificate's common name, as in `edge-hunter01`: access control goes by it
    expires: datetime.datetime  # UTC: the certificate, or its authority before it

    def require_valid(self, now_s: float) -> None:
        """Raise UserError once expired (Unix time): Zenoh checks the far end's certificate only."""
        if now_s >= self.expires.timestamp():
            raise UserError(f"{self.certificate} expired at {self.expires:%Y-%m-%d %H:%M} UTC")

    def zenoh_rows(self) -> Dict[str, Any]:
        """Zenoh's `transport/link/tls`: mutual, names verified, links closed when they expire."""
        return {
            "root_ca_certificate": self.ca,
            "listen_private_key": self.key,
            "listen_certificate": self.certificate,
            "connect_private_key": self.key,
            "connect_certificate": self.certificate,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }


def load_tls(directory: PathLike) -> TlsFiles:
    """Check the three files against one another and the clock; UserError where one is wrong."""
    # Here, so that a start without TLS saves the time and memory.
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature

    folder = Path(os.path.abspath(directory))  # Zenoh opens the files later.
    ca_path, path, key_path = (folder / name for name in (CA_FILE, CERTIFICATE_FILE, KEY_FILE))
    try:
        ca, certificate = (
            x509.load_pem_x509_certificate(read_bytes(each, "certificate"))
            for each in (ca_path, path)
        )
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        raise UserError(f"{path} is no certificate that {ca_path} has issued") from None
    key = read_private_key(key_path)
    # The group may read it: systemd passes credentials to a service like this.
    if key_path.stat().st_mode & 0o027:
        raise UserError(f"private key {key_path} is open to others; close it: chmod 600 {key_path}")
    if key.public_key() != certificate.public_key():
        raise UserError(f"private key {key_path} does not fit {CERTIFICATE_FILE} beside it")
    now = datetime.datetime.now(datetime.timezone.utc)
    for each, dated in ((path, certificate), (ca_path, ca)):
        begins, ends = dated.not_valid_before_utc, dated.not_valid_after_utc
        if now >= ends:
            raise UserError(f"{each} expired at {ends:%Y-%m-%d %H:%M} UTC; make a new one")
        if now < begins:
            raise UserError(f"{each} is valid from {begins:%Y-%m-%d %H:%M} UTC on; set the clock")
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    name = str(names[0].value) if names else ""
    ends = min(certificate.not_valid_after_utc, ca.not_valid_after_utc)
    return TlsFiles(str(ca_path), str(path), str(key_path), name, ends)


def read_private_key(path: PathLike) -> Any:
    """Read a private key of any kind, without a password; UserError where the file holds none."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    pem = read_bytes(path, "private key")
    try:
        return load_pem_private_key(pem, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError(f"{path} is not a private key in PEM without a password") from None


def read_signing_key(path: PathLike) -> Ed25519PrivateKey:
    """Read the Ed25519 key that signs policies and bundles; UserError for anything else."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = read_private_key(path)
    if not isinstance(key, Ed25519PrivateKey):
        raise UserError(f"{path} is not an Ed25519 key; `python -m deploy keys` makes one")
    return key


EDGE, SIMULATOR, OPERATOR = "edge", "simulator", "operator"
VIEWER, SHADOW, ROUTER = "viewer", "shadow", "router"


class Rights(NamedTuple):
    """One row of ROLES: the last parts of the keys under `phil/<vehicle_id>/`."""

    publishes: Tuple[str, ...] = ()
    reads: Tuple[str, ...] = ()
    answers: Tuple[str, ...] = ()  # queries that it replies to
    asks: Tuple[str, ...] = ()
    shows: Tuple[str, ...] = ()  # liveliness tokens of its own
    watches: Tuple[str, ...] = ()  # liveliness tokens of others
    all_vehicles: bool = False  # its rights hold for every vehicle, not for its own alone
    listens: bool = False  # others connect to it: its certificate is a server's, too


# `scene` and `simulator` are the bridge's: the picture for viewers, and its own token. `alive/**`
# is `alive` and whatever stands below it.
ROLES: Dict[str, Rights] = {
    EDGE: Rights(
        publishes=("command", "feedback", "health"),
        reads=("state",),
        answers=("status", "rearm"),
        shows=("alive/**",),
        watches=("alive/**",),  # Is there another one with this id?
    ),
    SIMULATOR: Rights(
        publishes=("state", "scene"),
        reads=("command", "feedback", "health"),
        asks=("status",),
        shows=("simulator",),
        watches=("alive/**",),
        listens=True,
    ),
    OPERATOR: Rights(asks=("status", "rearm")),
    # A policy beside the one that drives; it says nothing and asks nothing.
    SHADOW: Rights(reads=("state", "command", "feedback", "health", "scene"), watches=("**",)),
    VIEWER: Rights(reads=("*",), asks=("status",), watches=("**",), all_vehicles=True),
    # Only others connect to it; as somebody's peer it has no rights.
    ROUTER: Rights(all_vehicles=True, listens=True),
}

# For each right: Zenoh's messages from its owner, and those to it in return.
_MESSAGES: Dict[str, Tuple[List[str], List[str]]] = {
    "publishes": (["put"], ["declare_subscriber"]),
    "reads": (["declare_subscriber"], ["put"]),
    "answers": (["declare_queryable", "reply"], ["query"]),
    "asks": (["query"], ["declare_queryable", "reply"]),
    "shows": (["liveliness_token"], ["declare_liveliness_subscriber", "liveliness_query"]),
    "watches": (["declare_liveliness_subscriber", "liveliness_query"], ["liveliness_token"]),
}


def common_name(role: str, vehicle_id: Optional[str] = None) -> str:
    """Name a certificate: `edge-hunter01`, or `viewer` for a role of all vehicles."""
    if ROLES[role].all_vehicles:
        return role
    return f"{role}-{check_vehicle_id(str(vehicle_id))}"


def check_name(name: str, *able: str) -> None:
    """Raise UserError unless the certificate's name is one of `able`: Zenoh would drop silently."""
    if name not in able:
        right = f"name the directory of {' or '.join(able)}"
        raise UserError(f"--tls names the certificate of {name}; {right}")


def rules_for_simulator(tls: TlsFiles, vehicle_id: str, listens: bool) -> Dict[str, Any]:
    """Make the rules of a simulator's end; UserError for another party's certificate.

    A simulator that listens may use the router's certificate.
    """
    able = (ROUTER,) if listens else ()
    check_name(tls.name, common_name(SIMULATOR, vehicle_id), *able)
    return rules_for_listener([vehicle_id])


def rules_for_listener(vehicle_ids: Sequence[str]) -> Dict[str, Any]:
    """Make a listener's `access_control`: the rights of each party of these vehicles, no more."""
    parties = {
        common_name(role, vehicle_id): _rules(rights, vehicle_id)
        for role, rights in ROLES.items()
        for vehicle_id in ((None,) if rights.all_vehicles else vehicle_ids)
    }
    return _access_control(parties)


def rules_for_edge(vehicle_id: str) -> Dict[str, Any]:
    """Make an edge runtime's `access_control`: no other vehicle's simulator may pose as its own."""
    # The edge applies its own rights at its own end, where what it sends is egress.
    rules = _rules(ROLES[EDGE], vehicle_id, from_it="egress", to_it="ingress")
    return _access_control({common_name(SIMULATOR, vehicle_id): rules, ROUTER: rules})


def _rules(
    rights: Rights, vehicle_id: Optional[str], from_it: str = "ingress", to_it: str = "egress"
) -> List[Dict[str, Any]]:
    """Make the rules of one party, as its neighbour applies them."""
    rules = []
    for right, (sent, received) in _MESSAGES.items():
        keys = [f"phil/{vehicle_id or '*'}/{suffix}" for suffix in getattr(rights, right)]
        if keys:
            rules.append({"messages": sent, "flows": [from_it], "key_exprs": keys})
            rules.append({"messages": received, "flows": [to_it], "key_exprs": keys})
    return rules


def _access_control(rules_by_name: Dict[str, List[Dict[str, Any]]]) -> Dict[str, Any]:
    rules, subjects, policies = [], [], []
    for name, own in rules_by_name.items():
        if own:
            ids = [f"{name}-{number}" for number in range(len(own))]
            rules += [{"id": i, "permission": "allow", **rule} for i, rule in zip(ids, own)]
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"rules": ids, "subjects": [name]})
    access = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **access}
