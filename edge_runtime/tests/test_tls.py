"""The table of rights as Zenoh will read it; that Zenoh obeys: hil_tests/tests/test_tls.py."""

from datetime import datetime, timezone

import pytest
from cryptography.hazmat.primitives import serialization as form
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from edge_runtime import tls
from edge_runtime.util import UserError


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


def pem(key, encryption=None):
    encryption = encryption or form.NoEncryption()
    return key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, encryption)


def test_only_an_ed25519_key_without_a_password_signs(tmp_path):
    path, key, other = tmp_path / "key", Ed25519PrivateKey.generate(), ec.SECP256R1()
    path.write_bytes(pem(key))
    assert tls.read_signing_key(path).public_key() == key.public_key()
    path.write_bytes(pem(ec.generate_private_key(other)))
    assert isinstance(tls.read_private_key(path), ec.EllipticCurvePrivateKey)
    locked = pem(key, form.BestAvailableEncryption(b"secret"))
    for data in (b"no key", locked, path.read_bytes()):
        path.write_bytes(data)
        with pytest.raises(UserError):
            tls.read_signing_key(path)
    with pytest.raises(UserError):
        tls.read_signing_key(tmp_path / "absent")


def test_a_certificate_is_valid_until_the_second_of_its_end():
    ends = datetime(2026, 1, 2, tzinfo=timezone.utc)
    files = tls.TlsFiles("ca.pem", "cert.pem", "key.pem", "edge-a", ends)
    files.require_valid(ends.timestamp() - 0.001)
    with pytest.raises(UserError, match=r"cert.pem expired at 2026-01-02"):
        files.require_valid(ends.timestamp())
