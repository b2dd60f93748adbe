"""The table of rights as Zenoh will read it; that Zenoh obeys: hil_tests/tests/test_tls.py."""

from __future__ import annotations

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)

from edge_runtime.tls import (
    EDGE,
    ROLES,
    ROUTER,
    SIMULATOR,
    check_name,
    common_name,
    read_private_key,
    read_signing_key,
    rules_for_edge,
    rules_for_listener,
)
from edge_runtime.util import UserError
from edge_runtime.wire import TOPICS

SENDS = ("put", "reply", "liveliness_token", "declare_queryable")


def allowed(config, name, message, flow):
    """The keys on which `name` may do this."""
    (policy,) = [p for p in config["policies"] if p["subjects"] == [name]] or [{"rules": []}]
    return {
        key
        for rule in config["rules"]
        if rule["id"] in policy["rules"] and message in rule["messages"] and flow in rule["flows"]
        for key in rule["key_exprs"]
    }


def test_each_party_may_send_only_what_is_its_own():
    config = rules_for_listener(["a", "b"])
    assert allowed(config, "edge-a", "put", "ingress") == {
        "phil/a/command",
        "phil/a/feedback",
        "phil/a/health",
    }
    assert allowed(config, "simulator-a", "put", "ingress") == {"phil/a/state", "phil/a/scene"}
    for name in ("viewer", "operator-a", "router", "stranger"):
        for message in SENDS:
            assert allowed(config, name, message, "ingress") == set()
    assert allowed(config, "operator-b", "query", "ingress") == {"phil/b/status", "phil/b/rearm"}
    assert allowed(config, "edge-a", "liveliness_query", "ingress") == {"phil/a/alive/**"}
    assert "phil/a/rearm" not in allowed(config, "simulator-a", "query", "ingress")
    assert allowed(config, "viewer", "query", "ingress") == {"phil/*/status"}


def test_nobody_may_delete_and_the_rest_is_denied():
    config = rules_for_listener(["a"])
    assert (config["enabled"], config["default_permission"]) == (True, "deny")
    for rule in config["rules"]:
        assert rule["permission"] == "allow"
        assert "delete" not in rule["messages"]


def test_every_key_of_another_vehicle_is_out_of_reach():
    config = rules_for_listener(["a", "b"])
    for policy in config["policies"]:
        (name,) = policy["subjects"]
        if name.endswith("-a"):
            keys = {
                k for r in config["rules"] if r["id"] in policy["rules"] for k in r["key_exprs"]
            }
            assert keys
            assert all(key.startswith("phil/a/") for key in keys)


def test_an_edge_takes_states_from_its_simulator_or_a_router_only():
    config = rules_for_edge("a")
    assert [p["subjects"] for p in config["policies"]] == [["simulator-a"], ["router"]]
    assert allowed(config, "simulator-a", "put", "ingress") == {"phil/a/state"}
    assert allowed(config, "router", "query", "ingress") == {"phil/a/status", "phil/a/rearm"}
    assert "phil/a/command" in allowed(config, "simulator-a", "put", "egress")


def test_the_table_knows_every_topic_of_the_wire():
    columns = [column for rights in ROLES.values() for column in rights[:6]]
    named = {suffix.split("/")[0] for column in columns for suffix in column}
    assert set(TOPICS) <= named


def test_ids_are_unique_and_a_repeated_vehicle_counts_once():
    config = rules_for_listener(["a", "a"])
    assert config == rules_for_listener(["a"])
    ids = [rule["id"] for rule in config["rules"]]
    assert len(ids) == len(set(ids))


def test_a_wrong_name_says_which_would_be_right():
    check_name("edge-a", common_name(EDGE, "a"))
    with pytest.raises(UserError, match=r"certificate of viewer.*simulator-a or router"):
        check_name("viewer", common_name(SIMULATOR, "a"), common_name(ROUTER))
    with pytest.raises(UserError, match=r"of viewer, .* that of router; choose another directory$"):
        check_name("viewer", common_name(ROUTER))
    with pytest.raises(UserError, match="vehicle id"):
        common_name(EDGE, "a/b")


SM2 = """-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqBHM9VAYItBG0wawIBAQQgOT8zVOhnwMqKGmhW
bOaBqhJfcbJUpXzXnCKMbtoIVWqhRANCAASw9HXpv3hPTdG7qCzE6RYVYMKrbQRH
Vr/LhzTsFDjPQKyiO3ZuVQ2q4nEoMMYUN0FiBWkZ5VWDR6fIxYHvmw3f
-----END PRIVATE KEY-----
"""
"""Of a curve that cryptography reads and does not know."""


def pem(key, encryption=None):
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption or NoEncryption())


def test_a_signing_key_is_read(tmp_path):
    key = Ed25519PrivateKey.generate()
    path = tmp_path / "policy.key"
    path.write_bytes(pem(key))
    assert read_signing_key(path).public_key() == key.public_key()


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"no key", "is not a private key"),
        (SM2.encode(), "is not a private key"),
        (pem(Ed25519PrivateKey.generate(), BestAvailableEncryption(b"secret")), "password"),
        (pem(ec.generate_private_key(ec.SECP256R1())), "is not an Ed25519 key"),
    ],
)
def test_what_cannot_sign_is_said(tmp_path, data, part):
    path = tmp_path / "some.key"
    path.write_bytes(data)
    with pytest.raises(UserError, match=part):
        read_signing_key(path)


def test_a_key_of_another_kind_is_a_private_key(tmp_path):
    path = tmp_path / "some.key"
    path.write_bytes(pem(ec.generate_private_key(ec.SECP256R1())))
    assert isinstance(read_private_key(path), ec.EllipticCurvePrivateKey)
