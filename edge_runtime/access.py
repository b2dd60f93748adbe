"""Who may say and hear what, by the common name of the certificate: one table, no socket.

Zenoh filters only in the process that holds the configuration. That is whoever listens, the
simulator or the router, and each edge runtime for what comes to it. A refused message is dropped
without a word to its sender.
"""

from __future__ import annotations

from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from edge_runtime.errors import UserError
from edge_runtime.topics import check_vehicle_id

EDGE, SIMULATOR, OPERATOR, VIEWER, ROUTER = "edge", "simulator", "operator", "viewer", "router"


class Rights(NamedTuple):
    """One row of ROLES: the last parts of the keys under `phil/<vehicle_id>/`."""

    publishes: Tuple[str, ...] = ()
    reads: Tuple[str, ...] = ()
    answers: Tuple[str, ...] = ()
    """Queries that it replies to."""
    asks: Tuple[str, ...] = ()
    shows: Tuple[str, ...] = ()
    """Liveliness tokens of its own."""
    watches: Tuple[str, ...] = ()
    """Liveliness tokens of others."""
    all_vehicles: bool = False
    """Of every vehicle, not of its own alone."""
    listens: bool = False
    """Others connect to it: its certificate is a server's, too."""


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
    VIEWER: Rights(reads=("*",), asks=("status",), watches=("**",), all_vehicles=True),
    # Only others connect to it; as somebody's peer it has no rights.
    ROUTER: Rights(all_vehicles=True, listens=True),
}

# For each right: what comes from its owner, and what goes to it in return.
_MESSAGES: Dict[str, Tuple[List[str], List[str]]] = {
    "publishes": (["put"], ["declare_subscriber"]),
    "reads": (["declare_subscriber"], ["put"]),
    "answers": (["declare_queryable", "reply"], ["query"]),
    "asks": (["query"], ["declare_queryable", "reply"]),
    "shows": (["liveliness_token"], ["declare_liveliness_subscriber", "liveliness_query"]),
    "watches": (["declare_liveliness_subscriber", "liveliness_query"], ["liveliness_token"]),
}


def common_name(role: str, vehicle_id: Optional[str] = None) -> str:
    """The name in a certificate: `edge-hunter01`, or `viewer` for a role of all vehicles."""
    if ROLES[role].all_vehicles:
        return role
    return f"{role}-{check_vehicle_id(str(vehicle_id))}"


def rules_for_listener(vehicle_ids: Sequence[str]) -> Dict[str, Any]:
    """Zenoh's `access_control` for who listens: the rights of every party of these vehicles.

    All else is denied: other names, other keys, and `delete` for everybody.
    """
    parties: List[Tuple[str, Optional[str]]] = [
        (role, None) for role in ROLES if ROLES[role].all_vehicles
    ]
    for vehicle_id in dict.fromkeys(vehicle_ids):
        parties += [(role, vehicle_id) for role in ROLES if not ROLES[role].all_vehicles]
    return _access_control(
        {common_name(role, vehicle_id): _rules(role, vehicle_id) for role, vehicle_id in parties}
    )


def rules_for_edge(vehicle_id: str) -> Dict[str, Any]:
    """Zenoh's `access_control` for an edge runtime: what its simulator or a router may hand it.

    Without it, the simulator of another vehicle could pose as the one that this edge looks for:
    its certificate is a server's, too, and of the same authority.
    """
    rules = [_turned(rule) for rule in _rules(EDGE, vehicle_id)]
    return _access_control({common_name(SIMULATOR, vehicle_id): rules, ROUTER: rules})


def check_name(name: str, *able: str) -> None:
    """Raise UserError where a certificate's name is not one of those that are able to do this.

    Zenoh would not say so: the messages would go nowhere.
    """
    if name not in able:
        one_vehicles = any(each not in ROLES for each in able)
        raise UserError(
            f"--tls names the certificate of {name}, and this takes that of {' or '.join(able)};"
            f" choose another directory{', or another --vehicle-id' if one_vehicles else ''}"
        )


def _rules(role: str, vehicle_id: Optional[str]) -> List[Dict[str, Any]]:
    """The rows of one party, as its neighbour applies them."""
    rights, rows = ROLES[role], []
    for right, (from_it, to_it) in _MESSAGES.items():
        keys = [f"phil/{vehicle_id or '*'}/{suffix}" for suffix in getattr(rights, right)]
        if keys:
            rows.append({"messages": from_it, "flows": ["ingress"], "key_exprs": keys})
            rows.append({"messages": to_it, "flows": ["egress"], "key_exprs": keys})
    return rows


def _turned(rule: Dict[str, Any]) -> Dict[str, Any]:
    """The same rule as the party itself applies it: what it may send leaves here."""
    return {**rule, "flows": ["egress" if rule["flows"] == ["ingress"] else "ingress"]}


def _access_control(rules_by_name: Dict[str, List[Dict[str, Any]]]) -> Dict[str, Any]:
    rules, subjects, policies = [], [], []
    for name, rows in rules_by_name.items():
        if not rows:
            continue
        named = [{"id": f"{name}-{i}", "permission": "allow", **row} for i, row in enumerate(rows)]
        rules += named
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": [row["id"] for row in named], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
