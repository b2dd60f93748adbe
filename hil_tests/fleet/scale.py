"""From measured fleets to larger ones: what a vehicle costs, how many routers it takes. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from edge_runtime.wire import TOPICS

FLEETS = (10, 1_000, 100_000)
CORE_SHARE = 0.5
"""Of a core that a router may use on average: the other half is for the moment all come back."""
LINK_MBIT_S = 1000.0
LINK_SHARE = 0.5


def per_vehicle(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """What each further vehicle adds at the router: slopes over the measured fleets.

    Args:
        rows: reports of `drive.measure`, of at least two sizes.

    Raises:
        ValueError: fleets of one size only.
    """
    counts = [row["vehicles"] for row in rows]
    if len(set(counts)) < 2:
        raise ValueError("one size of a fleet has no slope")
    cpu, memory = (
        float(np.polyfit(counts, [row[name] for row in rows], 1)[0])
        for name in ("router_cpu_percent_of_a_core", "router_resident_mb")
    )
    largest = max(rows, key=lambda row: int(row["vehicles"]))
    up, down = (largest["link_of_a_simulator_kbit_s"][way] for way in ("sends", "receives"))
    health_bytes = largest["message_bytes"]["health"]
    return {
        "router_cpu_percent_of_a_core": cpu,
        "router_resident_mb": memory,
        # States come in from the simulator and go out to the edge runtime; commands back.
        "router_in_kbit_s": up + largest["link_of_an_edge_kbit_s"]["sends"],
        "router_out_kbit_s": down + largest["link_of_an_edge_kbit_s"]["receives"],
        "health_kbit_s": health_bytes * 8e-3 * TOPICS["health"].rate_hz,
    }


def project(each: dict[str, float], rules: Sequence[dict[str, float]]) -> list[dict[str, Any]]:
    """One row for each of FLEETS: routers, their load, the network, keys and certificates."""
    by_cpu = 100 * CORE_SHARE / each["router_cpu_percent_of_a_core"]
    by_link = 1e3 * LINK_MBIT_S * LINK_SHARE / max(each["router_in_kbit_s"],
                                                   each["router_out_kbit_s"])  # fmt: skip
    most = max(1, math.floor(min(by_cpu, by_link)))
    rule_bytes = max(rules, key=lambda row: row["vehicles"])
    rows = []
    for count in FLEETS:
        routers = math.ceil(count / most)
        held = math.ceil(count / routers)
        rows.append(
            {
                "vehicles": count,
                "vehicles_a_router_at_most": most,
                "routers": routers,
                "router_core_percent": held * each["router_cpu_percent_of_a_core"],
                "router_mb_for_links": held * each["router_resident_mb"],
                "router_in_mbit_s": held * each["router_in_kbit_s"] / 1e3,
                "all_routers_in_gbit_s": count * each["router_in_kbit_s"] / 1e6,
                "health_of_all_mbit_s": count * each["health_kbit_s"] / 1e3,
                "certificates": 3 * count + 1 + routers,
                "zenoh_keys": len(TOPICS) * count,
                "rules_file_mb": held * rule_bytes["file_bytes"] / rule_bytes["vehicles"] / 1e6,
            }
        )
    return rows
