"""The table of rights as Zenoh will read it; that Zenoh obeys: hil_tests/tests/test_tls.py."""

from datetime import datetime, timezone

import pytest
from cryptography.hazmat.primitives import serialization as form
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from edge_runtime import tls
from edge_runtime.util import UserError
from edge_runtime.wire import TOPICS


def allowed(config, name, message, flow):
    """The keys on which `name` may do this."""
    (policy,) = [p for p in config["policies"] if p["subjects"] == [name]] or [{"rules": []}]
    return {
        key
        for rule in config["rules"]
        if rule["id"] in policy["rules"] and message in rule["messages"] and flow in rule["flows"]
        for key in rule["key_exprs"]
    }


@pytest.mark.parametrize(
    ("name", "message", "keys"),
    [
        ("edge-a", "put", {"phil/a/command", "phil/a/feedback", "phil/a/health"}),
        ("edge-a", "liveliness_query", {"phil/a/alive/**"}),
        ("simulator-a", "put", {"phil/a/state", "phil/a/scene"}),
        ("operator-b", "query", {"phil/b/status", "phil/b/rearm"}),
        ("viewer", "query", {"phil/*/status"}),
        ("simulator-a", "query", {"phil/a/status"}),
        *(
            (name, message, set())
            for name in ("viewer", "operator-a", "router", "stranger")
            for message in ("put", "reply", "liveliness_token", "declare_queryable")
        ),
    ],
)
def test_each_party_may_send_only_what_is_its_own(name, message, keys):
    assert allowed(tls.rules_for_listener(["a", "b"]), name, message, "ingress") == keys


def test_no_key_of_another_vehicle_is_in_reach_and_the_rest_is_denied():
    config = tls.rules_for_listener(["a", "b"])
    assert (config["enabled"], config["default_permission"]) == (True, "deny")
    rules = {rule["id"]: rule for rule in config["rules"]}
    assert len(rules) == len(config["rules"])
    for policy in config["policies"]:
        (name,) = policy["subjects"]
        keys = {key for rule in policy["rules"] for key in rules[rule]["key_exprs"]}
        assert keys
        if name.endswith("-a"):
            assert all(key.startswith("phil/a/") for key in keys)
    for rule in rules.values():
        assert rule["permission"] == "allow"
        assert "delete" not in rule["messages"]
    assert tls.rules_for_listener(["a", "a"]) == tls.rules_for_listener(["a"])


def test_the_table_knows_every_topic_of_the_wire():
    columns = [column for rights in tls.ROLES.values() for column in rights[:6]]
    named = {suffix.split("/")[0] for column in columns for suffix in column}
    assert set(TOPICS) <= named


def test_a_wrong_name_says_which_would_be_right():
    tls.check_name("edge-a", tls.common_name(tls.EDGE, "a"))
    with pytest.raises(UserError, match=r"certificate of viewer.*simulator-a or router"):
        tls.check_name("viewer", tls.common_name(tls.SIMULATOR, "a"), tls.common_name(tls.ROUTER))
    with pytest.raises(UserError, match="vehicle id"):
        tls.common_name(tls.EDGE, "a/b")


def test_a_certificate_is_valid_until_the_second_of_its_end():
    ends = datetime(2026, 1, 2, tzinfo=timezone.utc)
    files = tls.TlsFiles("ca.pem", "cert.pem", "key.pem", "edge-a", ends)
    files.require_valid(ends.timestamp() - 0.001)
    with pytest.raises(UserError, match=r"cert.pem expired at 2026-01-02"):
        files.require_valid(ends.timestamp())


SM2 = """-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqBHM9VAYItBG0wawIBAQQgOT8zVOhnwMqKGmhW
bOaBqhJfcbJUpXzXnCKMbtoIVWqhRANCAASw9HXpv3hPTdG7qCzE6RYVYMKrbQRH
Vr/LhzTsFDjPQKyiO3ZuVQ2q4nEoMMYUN0FiBWkZ5VWDR6fIxYHvmw3f
-----END PRIVATE KEY-----
"""
"""Of a curve that cryptography reads and does not know."""


def pem(key, encryption=None):
    encryption = encryption or form.NoEncryption()
    return key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, encryption)


def test_a_signing_key_is_read_and_one_of_another_kind_is_a_private_key(tmp_path):
    path, key = tmp_path / "policy.key", Ed25519PrivateKey.generate()
    path.write_bytes(pem(key))
    assert tls.read_signing_key(path).public_key() == key.public_key()
    path.write_bytes(pem(ec.generate_private_key(ec.SECP256R1())))
    assert isinstance(tls.read_private_key(path), ec.EllipticCurvePrivateKey)


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"no key", "is not a private key"),
        (SM2.encode(), "is not a private key"),
        (pem(Ed25519PrivateKey.generate(), form.BestAvailableEncryption(b"secret")), "password"),
        (pem(ec.generate_private_key(ec.SECP256R1())), "is not an Ed25519 key"),
    ],
)
def test_what_cannot_sign_is_said(tmp_path, data, part):
    path = tmp_path / "some.key"
    path.write_bytes(data)
    with pytest.raises(UserError, match=part):
        tls.read_signing_key(path)
