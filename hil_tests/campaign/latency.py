"""The latency part of a campaign: drive what is missing, sum up, say what the policy bears."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from edge_runtime.latency.model import parse_spec
from edge_runtime.policy import load_policy
from hil_tests.campaign.axes import Axis
from hil_tests.campaign.budget import budget
from hil_tests.campaign.chunks import (
    CHUNK_EPISODES,
    Chunk,
    Task,
    chunks_of,
    kept_chunks,
    worth_keeping,
)
from hil_tests.campaign.rows import make_row
from hil_tests.campaign.workers import drive_chunks
from trainer.util import ProgressBar

REALTIME_CHUNK = 5
"""In real time an episode takes as long as it takes: small chunks share the work better."""


def run_latency(
    arguments: argparse.Namespace, policy: Path, axes: Sequence[Axis], keep: Path
) -> dict[str, Any]:
    """Sweep the axes and check against real time; the part ``latency`` of the report."""
    # The edge runtime checks signatures where it matters; here the loop is measured.
    policy_id = load_policy(str(policy), arguments.public_key, allow_unsigned=True).policy_id
    task = Task(
        policy, policy_id, arguments.scenario, arguments.condition, arguments.clock,
        arguments.public_key,
    )  # fmt: skip
    specs = list(dict.fromkeys(axis.spec(value) for axis in axes for value in axis.values))
    rows = drive_rows(task, specs, arguments.seed, arguments.runs, arguments.jobs, keep)
    checked = [str(parse_spec(spec)) for spec in arguments.check_realtime]
    driven_s, wall_s = (sum(row[name] for row in rows.values()) for name in ("driven_s", "wall_s"))
    return {
        "scenario": task.scenario,
        "condition": task.condition,
        "policy": str(policy),
        "policy_id": policy_id,
        "clock": task.clock,
        "seed": arguments.seed,
        "runs": arguments.runs,
        "axes": [
            {
                "name": axis.name,
                "title": axis.title,
                "unit": axis.unit,
                "values": axis.values,
                "specs": [axis.spec(value) for value in axis.values],
            }
            for axis in axes
        ],
        "rows": rows,
        "budget": budget(axes, rows, arguments.target, policy.stem) if axes else None,
        "faster_than_real_time": driven_s / wall_s if wall_s else None,
        "realtime_check": _check_realtime(task, checked, arguments, keep) if checked else None,
    }


def drive_rows(
    task: Task, specs: Sequence[str], seed: int, runs: int, jobs: int, keep: Path
) -> dict[str, dict[str, Any]]:
    """The rows of the specifications, from kept chunks where there are any."""
    store = kept_chunks(keep, task)
    size = REALTIME_CHUNK if task.clock == "realtime" else CHUNK_EPISODES
    chunks = {spec: chunks_of(spec, seed, runs, size) for spec in specs}
    asked = [chunk for spec in specs for chunk in chunks[spec]]
    kept = {chunk: store.load(asdict(chunk)) for chunk in asked}
    missing = [chunk for chunk in asked if kept[chunk] is None]
    with ProgressBar(f"latency, {task.clock}", len(asked), len(asked) - len(missing)) as bar:

        def on_chunk(chunk: Chunk, report: dict[str, Any], wall_s: float) -> None:
            kept[chunk] = result = worth_keeping(chunk, report, wall_s)
            store.save(asdict(chunk), result)
            bar.advance({"success": f"{report['success_rate']:.2f}", "of": chunk.spec})

        if missing:
            drive_chunks(task, missing, jobs, on_chunk)
    rows = {}
    for spec in specs:
        found = [report for chunk in chunks[spec] if (report := kept[chunk]) is not None]
        rows[spec] = make_row(spec, found)
    return rows


def _check_realtime(
    task: Task, specs: Sequence[str], arguments: argparse.Namespace, keep: Path
) -> dict[str, Any]:
    """Drive some rows in real time, too, and compare."""
    real_task, virtual_task = replace(task, clock="realtime"), replace(task, clock="lockstep")
    runs, seed = arguments.realtime_runs, arguments.seed
    virtual = drive_rows(virtual_task, specs, seed, runs, arguments.jobs, keep)
    real = drive_rows(real_task, specs, seed, runs, arguments.realtime_jobs, keep)
    compared = [
        {
            "spec": spec,
            "virtual": virtual[spec]["success"],
            "real": real[spec]["success"],
            "virtual_safe_stops_per_episode": virtual[spec]["safe_stops_per_episode"],
            "real_safe_stops_per_episode": real[spec]["safe_stops_per_episode"],
            "agree": agree(virtual[spec]["success"], real[spec]["success"]),
        }
        for spec in specs
    ]
    return {"runs": runs, "rows": compared, "agree": all(row["agree"] for row in compared)}


def agree(first: dict[str, float], second: dict[str, float]) -> bool:
    """Whether two intervals overlap."""
    return first["low"] <= second["high"] and second["low"] <= first["high"]
