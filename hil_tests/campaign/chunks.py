"""The unit of work: some episodes of one specification through a real edge runtime, kept on disk.

A campaign that was killed, or is asked for another row, computes only what is missing.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.report import GOAL
from hil_tests.kept import KeptResults

CHUNK_EPISODES = 50
FORMAT = 1
"""Raise it where the same specification begins to mean another drive: kept chunks become void."""


@dataclass(frozen=True)
class Task:
    """What every chunk of a campaign has in common."""

    policy: Path
    policy_id: str
    scenario: str
    condition: str
    clock: str
    public_key: str | None = None


@dataclass(frozen=True)
class Chunk:
    """Episodes with the seeds ``first_seed``, ``first_seed + 1``, ...: the same for every row."""

    spec: str
    first_seed: int
    episodes: int


def chunks_of(spec: str, seed: int, runs: int, size: int) -> list[Chunk]:
    """The chunks of one row."""
    return [Chunk(spec, seed + done, min(size, runs - done)) for done in range(0, runs, size)]


def halve(chunk: Chunk) -> tuple[Chunk, Chunk]:
    """Two chunks with the same episodes."""
    first = chunk.episodes // 2
    second_seed = chunk.first_seed + first
    return (
        Chunk(chunk.spec, chunk.first_seed, first),
        Chunk(chunk.spec, second_seed, chunk.episodes - first),
    )


def join_reports(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One report of ``bridge simulate`` for what was driven in parts.

    Latencies: the mean of the parts' p50, and the largest p99.
    """
    heard = [part["latency_ms"] for part in reports if part["latency_ms"]["p50"] is not None]
    rejected: Counter[str] = Counter()
    for part in reports:
        rejected.update(part["rejected"])
    episodes = [episode for part in reports for episode in part["per_episode"]]
    counts = ("deadline_misses", "tick_overruns", "safe_stops")
    return {
        "command": reports[0]["command"],
        "success_rate": sum(e["outcome"] == GOAL for e in episodes) / len(episodes),
        "latency_ms": {
            "p50": statistics.fmean(part["p50"] for part in heard) if heard else None,
            "p99": max(part["p99"] for part in heard) if heard else None,
        },
        **{name: sum(part[name] for part in reports) for name in counts},
        "rejected": dict(rejected),
        "per_episode": episodes,
    }


def kept_chunks(directory: Path, task: Task) -> KeptResults:
    """Where the chunks of a task are kept."""
    deciding = {"format": FORMAT, "policy": task.policy_id, "clock": task.clock}
    return KeptResults(directory, task.scenario, task.condition, deciding)


def worth_keeping(chunk: Chunk, report: dict[str, Any], wall_s: float) -> dict[str, Any]:
    """What the campaign needs of a report of ``bridge simulate``."""
    episodes = [
        {name: row[name] for name in ("seed", "outcome", "distance_m", "time_s", "steps")}
        for row in report["per_episode"]
    ]
    names = ("latency_ms", "deadline_misses", "tick_overruns", "rejected", "safe_stops")
    return {
        "spec": chunk.spec,
        "command": report["command"],
        "wall_s": round(wall_s, 3),
        **{name: report[name] for name in names},
        "episodes": episodes,
    }
