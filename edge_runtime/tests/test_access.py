"""The table of rights as Zenoh will read it; that Zenoh obeys: hil_tests/tests/test_tls_*.py."""

from __future__ import annotations

import pytest

from edge_runtime.access import (
    EDGE,
    ROLES,
    ROUTER,
    SIMULATOR,
    check_name,
    common_name,
    rules_for_edge,
    rules_for_listener,
)
from edge_runtime.errors import UserError
from edge_runtime.topics import TOPICS

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
