"""What both campaigns share: axes as data, parts driven side by side and kept, rows, the budget.

A campaign drives points (networks, loops, lags of the actuators), each with the same seeds, and
says up to which value of each axis the policy holds a share of successes.
"""

from __future__ import annotations

import shlex
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from bridge.progress import ProgressBar
from bridge.report import COLLISION, GOAL
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import make_directory, write_json
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError, read_json
from hil_tests.faults.rig import free_bus
from hil_tests.mock_hunter.hunter import make_parameters
from hil_tests.processes import CommandTimeoutError, Process, in_parallel, operator, trusting
from hil_tests.virtual_drive import Driven, VirtualDrive
from trainer.drivers import OnnxDriver, make_environment
from trainer.experiments.data import Estimate, mean_estimate, success_estimate
from trainer.experiments.plan import digest

LOOPS = POLICY, VEHICLE = ("policy", "vehicle")  # What may be in the loop
VEHICLE_ID = "campaign01"
MODEL = "hunter-2.0"
PART_LIMIT_S = 900.0
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


class Lag(NamedTuple):
    """A lag of the vehicle's actuators: a dead time and a time constant of the speed."""

    dead_ms: int
    constant_ms: int

    @property
    def spec(self) -> str:
        """Its name in the report."""
        return f"dead={self.dead_ms}ms,constant={self.constant_ms}ms"


DEAD_TIMES_MS = (0, 50, 100, 200, 300, 400, 500, 600, 800)
TIME_CONSTANTS_MS = (20, 50, 100, 200, 300, 500, 750, 1000)
LAGS = [Lag(dead, constant) for dead in DEAD_TIMES_MS for constant in TIME_CONSTANTS_MS]

Found = Mapping[str, Any]  # A part of a report's JSON
Rows = Mapping[str, Found]  # The report's rows by their specification


def limit_of(axis: Axis, rows: Rows, target: float) -> float | None:
    """The largest value up to which every tested one is at the target; None: not even 0 is."""
    limit: float | None = None
    for value in axis.values:
        if rows[axis.spec(value)]["success"]["value"] < target:
            return limit
        limit = value
    return limit


def budget(axes: Sequence[Axis], rows: Rows, target: float, name: str) -> dict[str, Any]:
    """Each axis's limit, whether it is only the end of what was tested, and the sentence."""
    limits = {axis.name: limit_of(axis, rows, target) for axis in axes}
    open_ended = {axis.name: limits[axis.name] == axis.values[-1] for axis in axes}
    goal, parts, missed = f"{target:.0%} success", [], []
    for axis in axes:
        limit = limits[axis.name]
        if limit is None:
            missed.append(f"on {axis.base} alone it is below that, so no {axis.name} has a budget")
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


def lag_budget(rows: Sequence[Found], target: float) -> dict[str, Any]:
    """Up to which sum of dead time and time constant every tested point holds the target.

    ``sum_ms`` is None where the least does not; ``measured_ms`` is the same by the lag that the
    drives showed (points where it could not be told are left out).
    """

    def limit(points: Sequence[tuple[float, Found]]) -> float | None:
        failing = [size for size, row in points if row["success"]["value"] < target]
        first = min(failing, default=float("inf"))
        return max((size for size, _ in points if size < first), default=None)

    return {
        "target_success": target,
        "sum_ms": limit([(row["dead_ms"] + row["constant_ms"], row) for row in rows]),
        "measured_ms": limit([(row["lag_ms"], row) for row in rows if row["lag_ms"] is not None]),
        "all_hold": all(row["success"]["value"] >= target for row in rows),
    }


class Task(NamedTuple):
    """What every drive of a campaign has in common. ``changes``: parameters of the mock Hunter."""

    policy: Path
    policy_id: str
    scenario: str
    condition: str
    seed: int
    runs: int
    public_key: str | None = None
    changes: Mapping[str, float] = {}

    def facts(self) -> dict[str, Any]:
        """As it stands in a report."""
        names = ("policy_id", "scenario", "condition", "seed", "runs")
        return {"policy": str(self.policy), **{name: getattr(self, name) for name in names}}


class Part(NamedTuple):
    """Episodes of one point (a network, one of LOOPS or a `Lag`), with the same seeds for each."""

    point: Any
    seed: int
    runs: int

    def split(self, size: int) -> list[Part]:
        """Parts of that many episodes at most, which cover each seed once."""
        return [
            Part(self.point, self.seed + done, min(size, self.runs - done))
            for done in range(0, self.runs, size)
        ]


def drive_all(
    task: Task,
    points: Sequence[Any],
    size: int,
    drive: Callable[[Task, Part], list[dict[str, Any]]],
    jobs: int,
    keep: Path,
    processes: bool = False,
) -> dict[Any, list[dict[str, Any]]]:
    """Drive the task's episodes at every point, ``jobs`` parts at a time; the results by point.

    A part has ``size`` episodes at most. What ``drive`` gives for it is kept in the directory
    ``keep``, in a file named by a hash of all that decides it, and not driven again. ``drive`` is
    called in threads, or in ``processes``.

    Raises:
        UserError: there can be no such directory, a kept result is no JSON, or a drive failed.
    """
    config = make_environment(task.scenario, task.condition).config
    deciding = {
        "format": FORMAT, "drive": drive.__name__, "policy": task.policy_id,
        "scenario": task.scenario, "condition": task.condition, "environment": asdict(config),
        "changes": task.changes,
    }  # fmt: skip
    make_directory(keep)
    parts = [one for point in points for one in Part(point, task.seed, task.runs).split(size)]
    paths = {one: keep / f"{digest({**deciding, **one._asdict()})}.json" for one in parts}
    found: dict[Part, list[dict[str, Any]]] = {
        one: read_json(path, "kept result (remove it)")
        for one, path in paths.items()
        if path.is_file()
    }
    # Whoever ends a campaign ends its processes.
    with sigterm_as_interrupt(), ProgressBar("parts", len(parts), len(found)) as bar:

        def on_done(one: Part, results: list[dict[str, Any]]) -> None:
            found[one] = results
            write_json(paths[one], results)
            bar.advance({"of": getattr(one.point, "spec", one.point)})

        missing = [one for one in parts if one not in found]
        in_parallel(partial(drive, task), missing, jobs, on_done, processes)
    return {
        point: [result for one in parts if one.point == point for result in found[one]]
        for point in points
    }


def run_rig(task: Task, part: Part, limit_s: float, *options: str, hunter: bool = False) -> Any:
    """Drive a part through processes of its own; the simulator's report, with its command.

    The simulator gets further ``options`` and ends within ``limit_s``. With ``hunter`` a mock
    Hunter on a CAN bus is in the loop, and an operator beside it. Raises UserError where a command
    failed, or did not end (CommandTimeoutError).
    """
    endpoint = free_endpoint()
    common = ("--vehicle-id", VEHICLE_ID)
    with tempfile.TemporaryDirectory(prefix="phil-rig-") as folder, ExitStack() as stack:
        vehicle: tuple[str, ...] = ()
        if hunter:
            bus, config = free_bus(), Path(folder) / "edge.toml"
            settings = [f"--set={name}={value}" for name, value in task.changes.items()]
            mock = ("hil_tests", "mock_hunter", "--bus", bus, *settings)
            stack.enter_context(Process(*mock, ready="ready"))
            config.write_text(f'bus = "{bus}"\n')
            vehicle = ("--vehicle", "hunter", "--config", str(config))
        edge = ("edge_runtime", "run", *trusting(task.policy, task.public_key), *vehicle)
        where = ("--connect", endpoint, *common)
        stack.enter_context(Process(*edge, *where, ready="ready"))
        if hunter:
            stack.enter_context(operator(endpoint, VEHICLE_ID))
        return simulate(
            endpoint, Path(folder) / "report.json", limit_s, *common, "--env", task.scenario,
            "--condition", task.condition, "--episodes", str(part.runs), "--seed", str(part.seed),
            *options,
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
        network = ("--clock", "lockstep", "--latency", part.point)
        report = run_rig(task, part, PART_LIMIT_S, *network)
    except UserError as error:
        # Any process of the machine may take the port before we do. And lock-step crawls beside an
        # edge runtime that has lost its wire: each step waits.
        passing = isinstance(error, CommandTimeoutError) or "is in use" in str(error)
        if not passing or attempts == 1:
            raise
        return drive_network(task, part, attempts // 2)
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


def drive_lag(task: Task, part: Part) -> list[dict[str, Any]]:
    """Drive a part with a lag of the actuators in virtual time; its one row."""
    lag: Lag = part.point
    env, driver = _loaded(task.policy, task.scenario, task.condition, task.public_key)
    times = {"dead_time_s": lag.dead_ms / 1e3, "speed_time_constant_s": lag.constant_ms / 1e3}
    virtual = VirtualDrive(env, driver, make_parameters(MODEL, {**task.changes, **times}))
    driven = [virtual.episode(part.seed + number) for number in range(part.runs)]
    return [lag_row(lag, driven, virtual.tracking.report(virtual.action_names))]


@cache
def _loaded(
    policy: Path, scenario: str, condition: str, public_key: str | None
) -> tuple[Any, OnnxDriver]:
    return make_environment(scenario, condition), OnnxDriver(policy, public_key)


def lag_row(lag: Lag, driven: Sequence[Driven], tracking: Found) -> dict[str, Any]:
    """What a point amounts to."""
    return {
        "spec": lag.spec,
        "dead_ms": lag.dead_ms,
        "constant_ms": lag.constant_ms,
        **summary([episode._asdict() for episode in driven]),
        "stops": sum(episode.stops for episode in driven),
        "lag_ms": tracking["lag_ms"]["speed"],
        "speed_error_mps": tracking["speed_error_mps"],
    }


def worth_keeping(report: Found) -> dict[str, Any]:
    """What a campaign keeps of a simulator's report."""
    names = ("command", "wall_s", "latency_ms", "deadline_misses", "safe_stops", "rejected",
             "tick_overruns", "vehicle")  # fmt: skip
    of_each = ("seed", "outcome", "distance_m", "time_s", "steps")
    reasons = Counter(event["reason"] for event in report["safe_stop_events"])
    return {
        **{name: report[name] for name in names},
        "safe_stop_reasons": dict(reasons),
        "episodes": [{name: row[name] for name in of_each} for row in report["per_episode"]],
    }


def make_row(spec: str, parts: Sequence[Found]) -> dict[str, Any]:
    """Join the parts of one point; latencies: the median of their p50, the largest p99."""
    episodes = [episode for part in parts for episode in part["episodes"]]
    outcomes = Counter(episode["outcome"] for episode in episodes)
    count = len(episodes)
    steps = sum(episode["steps"] for episode in episodes)
    vehicles = [part["vehicle"] for part in parts if part["vehicle"] is not None]
    return {
        "spec": spec,
        "episodes": count,
        **summary(episodes),
        "collision_rate": outcomes[COLLISION] / count,
        "safe_stops_per_episode": sum(part["safe_stops"] for part in parts) / count,
        "safe_stop_reasons": _counted(parts, "safe_stop_reasons"),
        "ticks_without_new_command": sum(part["deadline_misses"] for part in parts) / steps,
        "tick_overruns": sum(part["tick_overruns"] for part in parts),
        "latency_ms": _p50_p99([part["latency_ms"] for part in parts]),
        "rejected": _counted(parts, "rejected"),
        "driven_s": sum(episode["time_s"] for episode in episodes),
        "wall_s": sum(part["wall_s"] for part in parts),
        "command": parts[0]["command"],
        "vehicle": join_vehicles(vehicles) if vehicles else None,
        "per_episode": episodes,
    }


def join_vehicles(parts: Sequence[Found]) -> dict[str, Any]:
    """One report for several: errors pooled, the median else, the largest for max and p99."""
    first, samples = parts[0], [part["samples"] for part in parts]
    return {
        **{name: first[name] for name in ("name", "scale")},
        "samples": sum(samples),
        "speed_error_mps": _pool(samples, [part["speed_error_mps"] for part in parts]),
        "action_error": {
            name: _pool(samples, [part["action_error"][name] for part in parts])
            for name in first["action_error"]
        },
        "lag_ms": {
            name: _of_told(statistics.median, [part["lag_ms"][name] for part in parts])
            for name in first["lag_ms"]
        },
        "feedback_age_ms": _p50_p99([part["feedback_age_ms"] for part in parts]),
        "faults": _counted(parts, "faults"),
        "moving_starts": sum(part["moving_starts"] for part in parts),
    }


def _pool(samples: Sequence[int], errors: Sequence[Found]) -> dict[str, float | None]:
    told = [each for each in zip(samples, errors, strict=True) if each[1]["rmse"] is not None]
    if not told:
        return {"rmse": None, "max": None}
    squares = sum(count * error["rmse"] ** 2 for count, error in told)
    rmse = (squares / sum(count for count, _ in told)) ** 0.5
    return {"rmse": rmse, "max": max(error["max"] for _, error in told)}


def _p50_p99(times: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    return {
        "p50": _of_told(statistics.median, [each["p50"] for each in times]),
        "p99": _of_told(max, [each["p99"] for each in times]),
    }


def _of_told(join: Callable[[list[float]], float], values: Sequence[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return join(told) if told else None


def _counted(parts: Sequence[Found], name: str) -> dict[str, int]:
    return dict(sum((Counter(part[name]) for part in parts), Counter()))


def summary(episodes: Sequence[Found]) -> dict[str, Any]:
    """How episodes ended: success with Wilson's interval, distance with Student's, of 95 %."""
    outcomes = Counter(episode["outcome"] for episode in episodes)
    return {
        "success": interval(success_estimate(outcomes[GOAL], len(episodes))),
        "outcomes": dict(outcomes),
        "surviving_distance_m": interval(mean_estimate([e["distance_m"] for e in episodes])),
        "episode_time_s": statistics.fmean(episode["time_s"] for episode in episodes),
    }


def cost(policy: Sequence[Found], vehicle: Sequence[Found]) -> dict[str, Any]:
    """What the actuators cost in time, by seed, where both loops reach the goal; 95 % interval."""
    times = {row["seed"]: row["time_s"] for row in policy if row["outcome"] == GOAL}
    longer = [
        row["time_s"] - times[row["seed"]]
        for row in vehicle
        if row["outcome"] == GOAL and row["seed"] in times
    ]
    return {"seeds": len(longer), "longer_s": interval(mean_estimate(longer))}


def interval(estimate: Estimate) -> dict[str, float]:
    """An estimate as a report has it."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}
