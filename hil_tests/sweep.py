"""What both campaigns share: axes as data, rows of episodes, the budget's sentence, kept results.

A campaign drives the points of some axes, each with the same seeds, and says up to which value of
each the policy holds a share of successes. `campaign.py` does so for the network, `vehicle.py` for
the lag of a vehicle's actuators.
"""

from __future__ import annotations

import argparse
import shlex
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bridge.environments import CONDITIONS, NOMINAL
from bridge.network import parse_spec
from bridge.report import COLLISION, GOAL
from edge_runtime.cli import ArgumentParser, add_public_key, not_negative, positive, share
from edge_runtime.files import make_directory, write_json
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError, read_json
from hil_tests.processes import BackgroundCommand
from trainer.drivers import make_environment
from trainer.experiments.plan import digest
from trainer.experiments.statistics import Estimate, mean_estimate, success_estimate
from trainer.options import add_scenario
from trainer.util import ProgressBar

Item = TypeVar("Item")

LOOPS = POLICY, VEHICLE = ("policy", "vehicle")
"""What may be in the loop."""


@dataclass(frozen=True)
class Axis:
    """One line of a sweep: what gets worse along it, step by step."""

    name: str
    title: str
    unit: str
    values: tuple[float, ...]
    """Ascending."""
    pattern: str
    """The specification of a point; ``{}`` is the value."""
    base: str
    """The specification at value 0, and what the line is measured on."""
    limit: str
    """How the budget's sentence names the limit; ``{}`` is the value with its unit."""
    canonical: Callable[[str], str] = lambda text: str(parse_spec(text))

    def spec(self, value: float) -> str:
        """The specification at a value, in canonical form: the point's name in the report."""
        return self.canonical(self.pattern.format(f"{value:g}") if value else self.base)

    @property
    def specs(self) -> list[str]:
        """Of all its values."""
        return [self.spec(value) for value in self.values]

    def as_dict(self) -> dict[str, Any]:
        """As it stands in a report."""
        names = ("name", "title", "unit", "values", "specs")
        return {name: getattr(self, name) for name in names}


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
    """A lag of the vehicle's actuators."""

    dead_ms: int
    constant_ms: int

    @property
    def spec(self) -> str:
        """Its name in the report."""
        return f"dead={self.dead_ms}ms,constant={self.constant_ms}ms"

    def changes(self) -> dict[str, float]:
        """The mock's parameters."""
        return {
            "dead_time_s": self.dead_ms / 1e3,
            "speed_time_constant_s": self.constant_ms / 1e3,
        }


DEAD_TIMES_MS = (0, 50, 100, 200, 300, 400, 500, 600, 800)
TIME_CONSTANTS_MS = (20, 50, 100, 200, 300, 500, 750, 1000)
LINE_DEAD_MS, LINE_CONSTANT_MS = 50, 100
"""Where the lines lie: of the table, the values nearest to the mock's own (30 and 100 ms)."""
LAGS = [Lag(dead, constant) for dead in DEAD_TIMES_MS for constant in TIME_CONSTANTS_MS]
LAG_AXES = (
    Axis("dead_time", f"dead time, with a time constant of {LINE_CONSTANT_MS} ms", "ms",
         DEAD_TIMES_MS, f"dead={{}}ms,constant={LINE_CONSTANT_MS}ms",
         Lag(DEAD_TIMES_MS[0], LINE_CONSTANT_MS).spec,
         f"{{}} of dead time (time constant {LINE_CONSTANT_MS} ms)", str),
    Axis("time_constant", f"time constant, with a dead time of {LINE_DEAD_MS} ms", "ms",
         TIME_CONSTANTS_MS, f"dead={LINE_DEAD_MS}ms,constant={{}}ms",
         Lag(LINE_DEAD_MS, TIME_CONSTANTS_MS[0]).spec,
         f"{{}} of time constant (dead time {LINE_DEAD_MS} ms)", str),
)  # fmt: skip
"""Two lines through the table LAGS."""


def limit_of(axis: Axis, rows: Mapping[str, Mapping[str, Any]], target: float) -> float | None:
    """The largest tested value up to which success is at the target at every tested value.

    Success is the share of the row's episodes (the point estimate), and nothing is interpolated.
    None where it is below the target even at 0.
    """
    limit: float | None = None
    for value in axis.values:
        if rows[axis.spec(value)]["success"]["value"] < target:
            return limit
        limit = value
    return limit


def budget(
    axes: Sequence[Axis], rows: Mapping[str, Mapping[str, Any]], target: float, name: str
) -> dict[str, Any]:
    """Each axis's limit, whether it is only the end of what was tested, and the sentence."""
    limits = {axis.name: limit_of(axis, rows, target) for axis in axes}
    open_ended = {axis.name: limits[axis.name] == axis.values[-1] for axis in axes}
    return {
        "target_success": target,
        "limits": limits,
        "up_to_the_largest_tested": open_ended,
        "sentence": _sentence(axes, limits, open_ended, target, name),
    }


def _sentence(
    axes: Sequence[Axis],
    limits: Mapping[str, float | None],
    open_ended: Mapping[str, bool],
    target: float,
    name: str,
) -> str:
    parts, missed = [], []
    for axis in axes:
        limit = limits[axis.name]
        if limit is None and axis.base == NO_NETWORK:
            return f"{name} is below {target:.0%} success even on a perfect network."
        if limit is None:
            missed.append(f"on {axis.base} alone it is below that, so no {axis.name} has a budget")
            continue
        shown = axis.limit.format(f"{limit:g} {axis.unit}" if limit else "none")
        parts.append(f"{shown} (the most that was tested)" if open_ended[axis.name] else shown)
    if not parts:
        return f"{name}: " + "; ".join(missed) + "."
    listed = ", ".join(parts[:-1]) + (" and " if parts[:-1] else "") + parts[-1]
    held = f"{name} holds at least {target:.0%} success up to {listed}, one at a time"
    return "; ".join([held, *missed]) + "."


def make_row(spec: str, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Join what was driven over the wire under one specification, each part `worth_keeping`.

    Latencies are from state sent to command received: the median of the parts' p50 and the
    largest p99.
    """
    episodes = [episode for part in parts for episode in part["episodes"]]
    outcomes = Counter(episode["outcome"] for episode in episodes)
    count = len(episodes)
    heard = [part["latency_ms"] for part in parts if part["latency_ms"]["p50"] is not None]
    steps = sum(episode["steps"] for episode in episodes)
    return {
        "spec": spec,
        "episodes": count,
        **summary(episodes),
        "collision_rate": outcomes[COLLISION] / count,
        "safe_stops_per_episode": sum(part["safe_stops"] for part in parts) / count,
        "ticks_without_new_command": sum(part["deadline_misses"] for part in parts) / steps,
        "latency_ms": {
            "p50": statistics.median(latency["p50"] for latency in heard) if heard else None,
            "p99": max(latency["p99"] for latency in heard) if heard else None,
        },
        "rejected": dict(sum((Counter(part["rejected"]) for part in parts), Counter())),
        "driven_s": sum(episode["time_s"] for episode in episodes),
        "wall_s": sum(part["wall_s"] for part in parts),
        "command": parts[0]["command"],
        "per_episode": episodes,
    }


def summary(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How episodes ended: success with Wilson's interval, distance with Student's, of 95 %."""
    outcomes = Counter(episode["outcome"] for episode in episodes)
    return {
        "success": interval(success_estimate(outcomes[GOAL], len(episodes))),
        "outcomes": dict(outcomes),
        "surviving_distance_m": interval(mean_estimate([e["distance_m"] for e in episodes])),
        "episode_time_s": statistics.fmean(episode["time_s"] for episode in episodes),
    }


def interval(estimate: Estimate) -> dict[str, float]:
    """As it stands in a report."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


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


def task_of(arguments: argparse.Namespace) -> Task:
    """The task that is asked for; UserError where its policy does not load.

    The edge runtime checks signatures where it matters; here the loop is measured.
    """
    policy = Path(arguments.policy or f"results/policies/{arguments.scenario}.onnx")
    loaded = load_policy(str(policy), arguments.public_key, allow_unsigned=True)
    return Task(
        policy, loaded.policy_id, arguments.scenario, arguments.condition, arguments.seed,
        arguments.runs, arguments.public_key,
    )  # fmt: skip


def turns(seed: int, runs: int, size: int) -> list[tuple[int, int]]:
    """First seed and number of episodes of turns that cover each seed once."""
    return [(seed + done, min(size, runs - done)) for done in range(0, runs, size)]


class KeptResults:
    """A file for each result, named by a hash of all that decides it.

    Args:
        directory: where; it is made.
        task: whose scenario and condition, with the environment's settings, decide, too.
        deciding: what else all results have in common.

    Raises:
        UserError: there can be no such directory.
    """

    def __init__(self, directory: Path, task: Task, deciding: Mapping[str, Any]) -> None:
        config = make_environment(task.scenario, task.condition).config
        shared = {"scenario": task.scenario, "condition": task.condition}
        self._deciding = {**deciding, **shared, "environment": asdict(config)}
        self._directory = directory
        make_directory(directory)

    def complete(
        self,
        what: str,
        items: Sequence[Item],
        name: Callable[[Item], Mapping[str, Any]],
        drive: Callable[[list[Item], Callable[[Item, dict[str, Any]], None]], None],
        figures: Callable[[Item, dict[str, Any]], dict[str, str]],
    ) -> dict[Item, dict[str, Any]]:
        """The result of each item: those that are kept, and those that ``drive`` adds now.

        Args:
            what: is counted by the progress bar.
            items: in any order.
            name: an item's part of what decides its result.
            drive: called with the missing items, and with what is to be called with each result.
            figures: shown beside the bar after each.

        Raises:
            UserError: a kept result is no JSON.
        """
        paths = {item: self._path(name(item)) for item in items}
        found = {item: _read_kept(path) for item, path in paths.items() if path.is_file()}
        missing = [item for item in items if item not in found]
        with ProgressBar(what, len(items), len(found)) as bar:

            def on_done(item: Item, result: dict[str, Any]) -> None:
                found[item] = result
                write_json(paths[item], result)
                bar.advance(figures(item, result))

            if missing:
                drive(missing, on_done)
        return found

    def _path(self, one: Mapping[str, Any]) -> Path:
        return self._directory / f"{digest({**self._deciding, **one})}.json"


def _read_kept(path: Path) -> dict[str, Any]:
    try:
        result: dict[str, Any] = read_json(path, "kept result")
    except UserError as error:
        raise UserError(f"{error}; remove it") from None
    return result


def add_sweep_arguments(
    parser: ArgumentParser, parts: Sequence[str], runs: int, runs_help: str, target: float
) -> None:
    """The options that both campaigns have."""
    parser.add_argument(
        "--out",
        required=True,
        metavar="R.json",
        help="the report; R.md, pictures and R_rows/ (what is done already) go beside it",
    )
    default = "policy file (default: results/policies/SCENARIO.onnx)"
    parser.add_argument("--policy", metavar="P.onnx", help=default)
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument("--condition", choices=CONDITIONS, default=NOMINAL, help="scene")
    parser.add_argument("--only", choices=parts, help="one part (default: both)")
    for name, kind, value, text in (
        ("--runs", _several, runs, runs_help),
        ("--seed", not_negative, 0, "of the first episode"),
        ("--target", share, target, "success that is asked for"),
        (
            "--jobs",
            not_negative,
            0,
            "drives or faults side by side; 0: one a core",
        ),
    ):
        parser.add_argument(name, type=kind, default=value, help=text)


def _several(text: str) -> int:
    count = positive(text)
    if count < 2:
        raise argparse.ArgumentTypeError(f"{text} is too few: 2 or more have an interval")
    return count


def this_command() -> str:
    """The command line that makes a report, to stand in it."""
    return "python -m hil_tests " + shlex.join(sys.argv[1:])


def simulate(endpoint: str, vehicle_id: str, out: Path, limit_s: float, *words: str) -> Any:
    """Run ``bridge simulate`` beside an edge runtime; its report, with the command.

    ``wall_s`` of the report includes the simulator's start.

    Raises:
        UserError: it failed, or did not end (CommandTimeoutError).
    """
    arguments = ("bridge", "simulate", *words)
    here = ("--listen", endpoint, "--vehicle-id", vehicle_id, "--out", str(out))
    began_s = time.monotonic()
    with BackgroundCommand(*arguments, *here, quiet=True) as simulator:
        simulator.wait(limit_s)
    wall_s = round(time.monotonic() - began_s, 3)
    command = f"python -m {shlex.join(arguments)}"
    return {**read_json(out, "report"), "command": command, "wall_s": wall_s}


def worth_keeping(report: Mapping[str, Any]) -> dict[str, Any]:
    """What a campaign keeps of such a report."""
    names = ("command", "wall_s", "latency_ms", "deadline_misses", "safe_stops", "rejected")
    of_each = ("seed", "outcome", "distance_m", "time_s", "steps")
    episodes = [{name: row[name] for name in of_each} for row in report["per_episode"]]
    return {**{name: report[name] for name in names}, "episodes": episodes}
