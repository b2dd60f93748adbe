"""The keys on the wire: one table of topics, their rates and directions. Contract, section 3."""

from __future__ import annotations

import re
from typing import Dict, NamedTuple

from edge_runtime.errors import UserError

CONTROL_PERIOD_S = 0.1
DEFAULT_VEHICLE_ID = "hunter01"  # of both ends, so that a single vehicle needs no option


class Topic(NamedTuple):
    """One row of TOPICS."""

    suffix: str
    rate_hz: float
    direction: str


TOPICS: Dict[str, Topic] = {
    "state": Topic("state", 1 / CONTROL_PERIOD_S, "simulator to edge"),
    "command": Topic("command", 1 / CONTROL_PERIOD_S, "edge to simulator and vehicle"),
    "feedback": Topic("feedback", 20.0, "vehicle to all"),
    "health": Topic("health", 2.0, "edge to all"),
    "alive": Topic("alive", 0.0, "liveliness token of the edge"),
    "status": Topic("status", 0.0, "queryable of the edge: JSON"),
    "rearm": Topic("rearm", 0.0, "queryable of the edge: an operator lets it drive again"),
}
_VEHICLE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


def check_vehicle_id(vehicle_id: str) -> str:
    """The id itself; UserError if it could not be part of a key."""
    if not _VEHICLE_ID.fullmatch(vehicle_id):
        raise UserError(
            f"vehicle id {vehicle_id!r} is not valid: use 1 to 64 of A-Z a-z 0-9 _ -, like hunter1"
        )
    return vehicle_id


def key(vehicle_id: str, topic: str) -> str:
    """The Zenoh key of a row of TOPICS, as in `phil/hunter01/state`."""
    return f"phil/{check_vehicle_id(vehicle_id)}/{TOPICS[topic].suffix}"
