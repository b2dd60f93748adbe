"""From episodes to one row of the latency table. Pure."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from bridge.report import COLLISION, GOAL
from trainer.experiments.statistics import Estimate, mean_estimate, success_estimate


def make_row(spec: str, chunks: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Join the chunks of one specification.

    Success with Wilson's interval, distance with Student's, both of 95 %. Latencies are from state
    sent to command received: the median of the chunks' p50 and the largest p99.
    """
    episodes = [episode for chunk in chunks for episode in chunk["episodes"]]
    outcomes = Counter(episode["outcome"] for episode in episodes)
    count = len(episodes)
    heard = [chunk["latency_ms"] for chunk in chunks if chunk["latency_ms"]["p50"] is not None]
    rejected: Counter[str] = Counter()
    for chunk in chunks:
        rejected.update(chunk["rejected"])
    steps = sum(episode["steps"] for episode in episodes)
    return {
        "spec": spec,
        "episodes": count,
        "success": _as_dict(success_estimate(outcomes[GOAL], count)),
        "collision_rate": outcomes[COLLISION] / count,
        "outcomes": dict(outcomes),
        "surviving_distance_m": _as_dict(mean_estimate([e["distance_m"] for e in episodes])),
        "episode_time_s": statistics.fmean(e["time_s"] for e in episodes),
        "safe_stops_per_episode": sum(chunk["safe_stops"] for chunk in chunks) / count,
        "ticks_without_new_command": sum(chunk["deadline_misses"] for chunk in chunks) / steps,
        "latency_ms": {
            "p50": statistics.median(latency["p50"] for latency in heard) if heard else None,
            "p99": max(latency["p99"] for latency in heard) if heard else None,
        },
        "rejected": dict(rejected),
        "driven_s": sum(episode["time_s"] for episode in episodes),
        "wall_s": sum(chunk["wall_s"] for chunk in chunks),
        "command": chunks[0]["command"],
        "per_episode": episodes,
    }


def _as_dict(estimate: Estimate) -> dict[str, float]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}
