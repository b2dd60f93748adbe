"""The campaign of networks: axes as data, parts driven side by side and kept, rows, the budget.

It drives points (networks), each with the same seeds, and says up to which value of each axis the
policy holds a share of successes.
"""

from __future__ import annotations

import shlex
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

from bridge.progress import ProgressBar
from bridge.report import COLLISION, GOAL, TRUNCATED, UNTOLD, settled
from edge_runtime.files import make_directory, write_json
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError, parse_json, read_bytes, read_json
from hil_tests.processes import CommandTimeoutError, Process, in_parallel, trusting
from trainer.environments import make_environment
from trainer.experiments.data import Estimate, mean_estimate, success_estimate
from trainer.experiments.plan import digest
from trainer.scenarios import SCENARIOS

VEHICLE_ID = "campaign01"
PART_EPISODES, PART_LIMIT_S = 50, 900.0
ATTEMPTS = 6
FORMAT = 3  # Raise it where the same part begins to mean another drive: kept results become void


@dataclass(frozen=True)
class Axis:
    """One line of a sweep: what gets worse along it, step by step."""

    name: str
    title: str
    unit: str
    values: tuple[float, ...]  # Ascending
    pattern: str
    """The specification of a point, which is its name in the report; ``{}`` is the value."""
    base: str  # The specification at value 0, and what the line is measured on
    limit: str  # How the budget's sentence names the limit; ``{}`` is the value with its unit

    def spec(self, value: float) -> str:
        """The specification at a value."""
        return self.pattern.format(f"{value:g}") if value else self.base

    @property
    def specs(self) -> list[str]:
        """Of all its values."""
        return [self.spec(value) for value in self.values]


NO_NETWORK = "none"
SILENT = "{} says of no episode whether it succeeded: it needs outcome or is_success in its info"
_LATE = "delay=100ms"
"""What jitter is measured on: without delay, half of it would be cut off at zero."""
_MS = (0, 10, 20, 40, 60, 80, 100)

NETWORK_AXES = (
    Axis("delay", "delay each way", "ms",
         (0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 400, 500, 750, 1000),
         "delay={}ms", NO_NETWORK, "{} of delay each way"),
    Axis("jitter", "normal jitter (standard deviation) on 100 ms each way", "ms", _MS,
         f"{_LATE},jitter={{}}ms", _LATE, "{} of normal jitter on 100 ms"),
    Axis("tail", "long-tailed (Pareto) jitter on 100 ms each way", "ms", _MS,
         f"{_LATE},jitter={{}}ms,tail=pareto", _LATE, "{} of long-tailed jitter on 100 ms"),
    Axis("loss", "independent loss each way", "%", (0, 1, 2, 5, 10, 15, 20, 25, 30, 40),
         "loss={}%", NO_NETWORK, "{} of independent loss each way"),
    Axis("burst", "loss in bursts of 5 messages each way", "%", (0, 1, 2, 5, 10, 15, 20, 30),
         "loss={}%,burst=5", NO_NETWORK, "{} of loss in bursts of 5 messages"),
    Axis("outage", "outage every 3 s, both ways", "s",
         (0, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0),
         "outage={}s/3s@1s", NO_NETWORK, "outages of {} every 3 s"),
)  # fmt: skip
"""Every setting holds each way, as in ``--latency``. Delay runs from 0 to 500 ms there and back in
steps of 50 ms, and on to where nobody drives."""


Found = Mapping[str, Any]  # A part of a report's JSON
Rows = Mapping[str, Found]  # The report's rows by their specification


def limit_of(axis: Axis, rows: Rows, target: float) -> float | None:
    """The largest value up to which every tested one is at the target; None: not even 0 is."""
    holds = takewhile(lambda v: rows[axis.spec(v)]["success"]["value"] >= target, axis.values)
    return max(holds, default=None)


def budget(axes: Sequence[Axis], rows: Rows, target: float, name: str) -> dict[str, Any]:
    """Each axis's limit, whether it is only the end of what was tested, and the sentence."""
    limits = {axis.name: limit_of(axis, rows, target) for axis in axes}
    open_ended = {axis.name: limits[axis.name] == axis.values[-1] for axis in axes}
    goal, parts, missed = f"{100 * target:g}% success", [], []
    for axis in axes:
        limit = limits[axis.name]
        if limit is None:
            missed.append(f"on {axis.base} alone it is below {goal}: no {axis.name} has a budget")
        else:
            shown = axis.limit.format(f"{limit:g} {axis.unit}" if limit else "none")
            most = " (the most that was tested)" if open_ended[axis.name] else ""
            parts.append(f"{shown}{most}")
    if any(limits[axis.name] is None and axis.base == NO_NETWORK for axis in axes):
        sentence = f"{name} is below {goal} even on a perfect network."
    elif parts:
        listed = ", ".join(parts[:-1]) + (" and " if parts[:-1] else "") + parts[-1]
        holds = f"{name} holds at least {goal} up to {listed}, one at a time"
        sentence = "; ".join([holds, *missed]) + "."
    else:
        sentence = f"{name}: " + "; ".join(missed) + "."
    return {
        "target_success": target,
        "limits": limits,
        "up_to_the_largest_tested": open_ended,
        "sentence": sentence,
    }


class Task(NamedTuple):
    """What every drive of a campaign has in common."""

    policy: Path
    policy_id: str
    scenario: str
    condition: str
    seed: int
    runs: int
    public_key: str | None = None
    period_s: float | None = None

    def facts(self) -> dict[str, Any]:
        """As it stands in a report."""
        names = ("policy_id", "scenario", "condition", "seed", "runs")
        return {"policy": str(self.policy), **{name: getattr(self, name) for name in names}}


class Part(NamedTuple):
    """Episodes of one point (a network), with the same seeds for each."""

    point: str
    seed: int
    runs: int

    def split(self, size: int) -> list[Part]:
        """Parts of that many episodes at most, which cover each seed once."""
        return [
            Part(self.point, self.seed + done, min(size, self.runs - done))
            for done in range(0, self.runs, size)
        ]


def drive_all(
    task: Task, points: Sequence[str], jobs: int, keep: Path
) -> dict[str, list[dict[str, Any]]]:
    """Drive the task's episodes at every point, ``jobs`` parts at a time; the results by point.

    A part has PART_EPISODES at most. What `drive_network` gives for it is kept in the directory
    ``keep``, in a file named by a hash of all that decides it, and not driven again.

    Raises:
        UserError: there can be no such directory, a kept result is no JSON, or a drive failed.
    """
    ours = task.scenario in SCENARIOS
    environment = asdict(make_environment(task.scenario, task.condition).config) if ours else None
    deciding = {
        "format": FORMAT, "drive": "drive_network", "policy": task.policy_id,
        "scenario": task.scenario, "condition": task.condition, "environment": environment,
    }  # fmt: skip
    make_directory(keep)
    whole = (Part(point, task.seed, task.runs) for point in points)
    parts = [one for each in whole for one in each.split(PART_EPISODES)]
    paths = {one: keep / f"{digest({**deciding, **one._asdict()})}.json" for one in parts}
    found: dict[Part, list[dict[str, Any]]] = {
        one: parse_json(read_bytes(path, "kept result"), f"kept result {path} (remove it)")
        for one, path in paths.items()
        if path.is_file()
    }
    with ProgressBar("parts", len(parts), len(found)) as bar:

        def on_done(one: Part, results: list[dict[str, Any]]) -> None:
            found[one] = results
            write_json(paths[one], results)
            bar.advance({"of": one.point})

        missing = [one for one in parts if one not in found]
        in_parallel(partial(drive_network, task), missing, jobs, on_done)
    rows = [row for results in found.values() for one in results for row in one["episodes"]]
    for row, outcome in zip(rows, settled(row["outcome"] for row in rows), strict=True):
        row["outcome"] = outcome
    if UNTOLD.issuperset(row["outcome"] for row in rows):
        raise UserError(SILENT.format(task.scenario))
    return {
        point: [result for one in parts if one.point == point for result in found[one]]
        for point in points
    }


def run_rig(task: Task, part: Part) -> Any:
    """Drive a part through processes of its own; the simulator's report, with its command.

    Raises UserError where a command failed, or did not end (CommandTimeoutError).
    """
    endpoint = free_endpoint()
    common = ("--vehicle-id", VEHICLE_ID)
    edge = ("edge_runtime", "run", *trusting(task.policy, task.public_key), *common)
    with (
        tempfile.TemporaryDirectory(prefix="phil-rig-") as folder,
        Process(*edge, "--connect", endpoint, ready="ready"),
    ):
        return simulate(
            endpoint, Path(folder) / "report.json", PART_LIMIT_S, *common, "--env", task.scenario,
            "--condition", task.condition, "--episodes", str(part.runs), "--seed", str(part.seed),
            "--clock", "lockstep", "--latency", part.point,
            *(("--period", str(task.period_s)) if task.period_s else ()),
        )  # fmt: skip


def simulate(endpoint: str, out: Path, limit_s: float, *options: str) -> dict[str, Any]:
    """Run ``bridge simulate`` (``wall_s``: with its start); UserError where it fails or hangs."""
    words, began_s = ("bridge", "simulate", *options), time.monotonic()
    with Process(*words, "--listen", endpoint, "--out", str(out)) as simulator:
        simulator.succeed(limit_s)
    wall_s = round(time.monotonic() - began_s, 3)
    return {
        **read_json(out, "report"),
        "command": f"python -m {shlex.join(words)}",
        "wall_s": wall_s,
    }


def drive_network(task: Task, part: Part, attempts: int = ATTEMPTS) -> list[dict[str, Any]]:
    """Drive a part in lock-step behind its network, and a disturbed one again in halves.

    The edge runtime lives in wall time: where it gets no processor for 2 T it rightly stops, and
    virtual time knows nothing of that.
    """
    try:
        report = run_rig(task, part)
    except UserError as error:
        # Any process of the machine may take the port before we do. And lock-step crawls beside an
        # edge runtime that has lost its wire: each step waits.
        passing = isinstance(error, CommandTimeoutError) or "is in use" in str(error)
        if not passing or attempts == 1:
            raise
        return drive_network(task, part, attempts // 2)
    # Behind a network a limit of steps may end all of a part; the other parts tell what that is.
    limited = part.point != NO_NETWORK and all(
        row["outcome"] == TRUNCATED for row in report["per_episode"]
    )
    if report["success_rate"] is None and not limited:
        raise UserError(SILENT.format(task.scenario))
    if not report["wall_clock_stalls"]:
        return [worth_keeping(report)]
    if attempts == 1:
        raise UserError(
            f"{part.point}: the edge runtime gets too little processor time for a drive "
            "without a pause; use fewer --jobs (rows that are done are kept)"
        )
    if part.runs == 1:
        return drive_network(task, part, attempts - 1)
    halves = part.split((part.runs + 1) // 2)
    return [found for half in halves for found in drive_network(task, half, attempts)]


def worth_keeping(report: Found) -> dict[str, Any]:
    """What a campaign keeps of a simulator's report."""
    names = ("command", "wall_s", "latency_ms", "deadline_misses", "safe_stops", "rejected")
    of_each = ("seed", "outcome", "distance_m", "time_s", "steps")
    reasons = Counter(event["reason"] for event in report["safe_stop_events"])
    return {
        **{name: report[name] for name in names},
        "safe_stop_reasons": dict(reasons),
        "episodes": [{name: row[name] for name in of_each} for row in report["per_episode"]],
    }


def make_row(spec: str, parts: Sequence[Found]) -> dict[str, Any]:
    """Join the parts of one point; latencies: the median of their p50, the largest p99.

    Success has Wilson's interval, the surviving distance Student's, of 95 %.
    """
    episodes = [episode for part in parts for episode in part["episodes"]]
    outcomes = Counter(episode["outcome"] for episode in episodes)
    count, driven_s = len(episodes), sum(episode["time_s"] for episode in episodes)
    steps = sum(episode["steps"] for episode in episodes)
    latencies = [part["latency_ms"] for part in parts if part["latency_ms"]["p50"] is not None]
    return {
        "spec": spec,
        "episodes": count,
        "success": interval(success_estimate(outcomes[GOAL], count)),
        "outcomes": dict(outcomes),
        "surviving_distance_m": interval(mean_estimate([e["distance_m"] for e in episodes])),
        "episode_time_s": driven_s / count,
        "collision_rate": outcomes[COLLISION] / count,
        "safe_stops_per_episode": sum(part["safe_stops"] for part in parts) / count,
        "safe_stop_reasons": _counted(parts, "safe_stop_reasons"),
        "ticks_without_new_command": sum(part["deadline_misses"] for part in parts) / steps,
        "latency_ms": {
            "p50": statistics.median(each["p50"] for each in latencies) if latencies else None,
            "p99": max((each["p99"] for each in latencies), default=None),
        },
        "rejected": _counted(parts, "rejected"),
        "driven_s": driven_s,
        "wall_s": sum(part["wall_s"] for part in parts),
        "command": parts[0]["command"],
        "per_episode": episodes,
    }


def _counted(parts: Sequence[Found], name: str) -> dict[str, int]:
    return dict(sum((Counter(part[name]) for part in parts), Counter()))


def interval(estimate: Estimate) -> dict[str, float]:
    """An estimate as a report has it."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}
