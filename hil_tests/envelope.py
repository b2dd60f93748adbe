"""``python -m hil_tests envelope``: find the smallest networks that break a policy.

Each axis is searched alone, then all together. A point is driven until a sequential test has
decided, in process and in virtual time, which equals the drive over the wire to the bit
(`tests/test_loop.py`). Every point drives the same seeds.
"""

from __future__ import annotations

import argparse
import math
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypedDict

from matplotlib.figure import Figure
from msgspec import convert

from bridge.network import LatencySpec, parse_spec
from bridge.outcomes import GOAL, TIMEOUT, TRUNCATED, UNKNOWN, success_estimate
from bridge.report import EpisodeResult, write_figure
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError, read_json
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes, load_driver, located, trained_in
from trainer.util import cores, die_with_parent, fitting, kept, set_threads

HOLDS, BREAKS, BETWEEN = "holds", "breaks", "between"
CONFIDENCE = 0.95  # Of a statement about an axis
ZONE = 0.7
"""The test distinguishes the promise from 0.7 times more, and 0.7 times fewer, failures: 95 % from
91.5 % and from 98.5 %."""
TRIES = 8  # About the number of points on an axis; the error of each is that much smaller
MOST_FAILURES = 50  # A point is left undecided after the drives that have so many at the promise
PANELS = 3  # In a row of a picture
AT_ONCE = 16  # Drives between two checks whether a point is decided
OUTAGE_EVERY_S, OUTAGE_START_S = 3.0, 0.97  # Off the ticks, so that rounding decides nothing
BURST_PERCENT = 5.0  # Share of the messages in bad stretches
JITTER_FLOOR = 2.0  # The least delay, in standard deviations of the jitter, which zero would cut
SHARES = 20  # Steps of all axes together, from 0 to every limit in full

AXES = {
    "delay_ms": (1000.0, 10.0),  # Each way, as all below
    "jitter_ms": (200.0, 5.0),  # Standard deviation, normal
    "tail_jitter_ms": (200.0, 5.0),  # The same, Pareto
    "loss_percent": (50.0, 1.0),  # Independent
    "burst_messages": (10.0, 0.5),  # Mean run of lost messages; below 1: none
    "outage_s": (2.0, 0.05),  # Both ways at once, every 3 s
}
"""Each axis's largest value, and its resolution."""


class Tried(TypedDict):
    verdict: str
    drives: int
    successes: int
    at: dict[str, float]  # The point, without zeros


Point = Mapping[str, float]  # Axis -> value; 0 where it is missing
Ray = Callable[[int], Point]  # The point of a step; 0 is a perfect network
Drive = Callable[[LatencySpec, Sequence[int]], Sequence[bool]]
"""Drives these seeds behind a network; returns the success of each."""


def network(at: Point) -> LatencySpec:
    delay_ms, jitter_ms, tail_ms, loss, burst, outage_s = (at.get(name, 0.0) for name in AXES)
    spread_ms, has_bursts = jitter_ms or tail_ms, burst >= 1.0
    every = f"s/{OUTAGE_EVERY_S:g}s@{OUTAGE_START_S:g}s"
    lost = loss + has_bursts * BURST_PERCENT * (1.0 - loss / 100.0)
    settings = {
        "delay": (max(delay_ms, JITTER_FLOOR * spread_ms), "ms"), "jitter": (spread_ms, "ms"),
        "loss": (lost, "%"), "clear_loss": (loss * has_bursts, "%"),
        "burst": (burst * has_bursts, ""), "outage": (outage_s, every),
    }  # fmt: skip
    words = [f"{name}={value:.9g}{unit}" for name, (value, unit) in settings.items() if value]
    return parse_spec(",".join(words + ["tail=pareto"] * (tail_ms > 0)))


class SequentialTest:
    """Decides with few drives whether the success rate is above or below a promise.

    Two of Wald's sequential probability ratio tests (1945, Sequential tests of statistical
    hypotheses, Annals of Mathematical Statistics 16(2)) on the same drives, as Sobel and Wald
    (1949, the same journal, 20(4)) choose one of three hypotheses: the promise against ``ZONE``
    fewer failures, and against ``ZONE`` more. BETWEEN: neither could be shown.
    """

    def __init__(self, promise: float) -> None:
        failing, error = 1.0 - promise, 1.0 - CONFIDENCE
        self._steps = [
            (math.log(other / failing), math.log((1.0 - other) / promise))
            for other in (failing * (1.0 - ZONE), failing * (1.0 + ZONE))
        ]
        self._up = math.log((1.0 - error) * TRIES / error)
        self._down = math.log(error / (1.0 - error / TRIES))
        self._ratios, self._open = [0.0, 0.0], [True, True]
        self.most = round(MOST_FAILURES / failing)
        self.drives = self.successes = 0

    def add(self, success: bool) -> str | None:
        self.drives += 1
        self.successes += success
        for which, verdict in enumerate((HOLDS, BREAKS)):
            if self._open[which]:
                self._ratios[which] += self._steps[which][success]
                if self._ratios[which] >= self._up:
                    return verdict
                self._open[which] = self._ratios[which] > self._down
        return None if any(self._open) and self.drives < self.most else BETWEEN


class Search:
    """Searches for edges; calls ``keep`` after each point, whose verdict is in ``tried``.

    ``drive`` is called with the next AT_ONCE seeds, from ``seed`` on, until a point is decided.
    """

    def __init__(
        self, drive: Drive, promise: float, seed: int = 0, keep: Callable[[], None] = lambda: None
    ) -> None:
        self._drive, self._promise, self._seed, self._keep = drive, promise, seed, keep
        self.tried: dict[str, Tried] = {}
        self.edges: dict[str, dict[str, Any]] = {}

    def verdict(self, at: Point) -> str:
        spec = network(at)
        if str(spec) not in self.tried:
            test, verdict = SequentialTest(self._promise), None
            while verdict is None:
                first = self._seed + test.drives
                for success in self._drive(spec, range(first, first + AT_ONCE)):
                    verdict = verdict or test.add(success)
            where = {name: value for name, value in at.items() if value}
            self.tried[str(spec)] = Tried(
                verdict=verdict, drives=test.drives, successes=test.successes, at=where
            )
            self._keep()
            print(f"{spec}: {verdict} ({test.successes} of {test.drives})", file=sys.stderr)
        return self.tried[str(spec)]["verdict"]

    def edge(self, ray: Ray, most: int) -> dict[str, Any]:
        """Return the largest step that holds and the smallest beyond that breaks, as networks, too.

        The latter is None if none breaks.
        """
        inside = self._bisect(ray, 0, most, (HOLDS,))[0]
        if inside > 1 and self.verdict(ray(inside // 2)) != HOLDS:  # A milder one may be worse
            inside = self._bisect(ray, 0, inside // 2, (HOLDS,))[0]
        beyond = self._bisect(ray, inside, most, (HOLDS, BETWEEN))[1]
        outside = beyond if beyond <= most else None
        found = {"steps": (inside, outside), "inside": str(network(ray(inside)))}
        return {**found, "outside": None if outside is None else str(network(ray(outside)))}

    def _bisect(self, ray: Ray, low: int, most: int, is_low: tuple[str, ...]) -> tuple[int, int]:
        """Return neighbouring steps, the lower with a verdict in ``is_low``; try ``most`` first."""
        middle, high = most, most + 1
        while high - low > 1:
            low, high = (middle, high) if self.verdict(ray(middle)) in is_low else (low, middle)
            middle = (low + high) // 2
        return low, high


def find_edges(search: Search) -> dict[str, dict[str, Any]]:
    """Return ``limit``, ``breaks_at`` and their networks for each axis, and for all together.

    Together, the values are shares of the limits, with the jitter whose limit is smaller. Raises
    UserError if the promise is not kept on a perfect network.
    """
    if search.verdict({}) != HOLDS:
        raise UserError("the promise is not kept even on a perfect network: lower --promise")
    edges = search.edges

    def find(name: str, full: Point, steps: int, step: float) -> None:
        found = search.edge(
            lambda k: {each: k / steps * most for each, most in full.items()}, steps
        )
        limit, breaks_at = (k and round(k * step, 6) for k in found.pop("steps"))
        edges[name] = {"limit": limit, "breaks_at": breaks_at, **found}

    for name, (most, step) in AXES.items():
        find(name, {name: most}, round(most / step), step)
    limits = {name: edge["limit"] for name, edge in edges.items()}
    del limits[max(("jitter_ms", "tail_jitter_ms"), key=limits.__getitem__)]
    find("together", limits, SHARES, 1 / SHARES)
    return edges


def run(arguments: argparse.Namespace) -> int:
    """Find an envelope; write the progress after each network, and resume an unfinished one."""
    out = arguments.out
    check_writable(out)
    policy = arguments.policy or kept(f"results/policies/{arguments.env}.onnx")
    task = (policy, arguments.env, arguments.condition, arguments.public_key, arguments.jobs)
    with sigterm_as_interrupt(), Drivers(*task) as drivers:
        about = {
            "schema": 2, "policy_id": drivers.policy_id, "env": arguments.env,
            "condition": arguments.condition, "promised_success": arguments.promise,
            "confidence": CONFIDENCE, "seed": arguments.seed, "policy": policy,
        }  # fmt: skip

        def drive(spec: LatencySpec, seeds: Sequence[int]) -> list[bool]:
            return [result.outcome == GOAL for result in drivers.drive(spec, seeds)]

        def is_any() -> bool:
            alone = search.tried.get(str(network({})))
            return alone is not None and alone["verdict"] == HOLDS

        def keep(complete: bool = False) -> None:
            if not is_any():
                return
            found = {"complete": complete, "edges": search.edges, "tried": search.tried}
            command = f"python -m hil_tests {shlex.join(sys.argv[1:])}"
            write_json_out(out, {**about, **found, "command": command})

        search = Search(drive, arguments.promise, arguments.seed, keep)
        begun = read_json(out, "envelope") if Path(out).exists() else {}
        if begun.get("complete") is False and about.items() <= begun.items():
            with fitting(f"{out} is no envelope that can be resumed: name another --out"):
                search.tried = convert(begun["tried"], dict[str, Tried])
            print(f"resumed: {len(search.tried)} networks are known from {out}", file=sys.stderr)
        try:
            find_edges(search)
            keep(complete=True)
        finally:
            if is_any():
                write_figure(draw_axes(_swept(about, search)), Path(out).with_suffix(".png"))
    for name, edge in search.edges.items():
        print(f"{name} holds up to {edge['limit']:g}, breaks at {edge['breaks_at']}")
    return 0


class UntoldError(UserError):
    """The environment does not report how a drive ended."""


class Drivers(ProcessPoolExecutor):
    """Processes, each with an environment and the policy; 0 jobs: one a core. UserError."""

    def __init__(self, policy: str, env: str, condition: str, public_key: str | None, jobs: int):
        policy = located(policy)
        task = (policy, env, condition, public_key, trained_in(policy, public_key)[1])
        self.policy_id = _load(*task)[2]
        self._ends = {TRUNCATED}  # Outcomes of all drives so far
        super().__init__(jobs or cores(), get_context("spawn"), partial(_begin, *task))

    def __exit__(self, *_: object) -> None:
        self.shutdown(cancel_futures=True)

    def submit(self, *arguments: Any, **named: Any) -> Any:
        """Start processes with SIGINT blocked, from their loading on: ^C ends only the parent."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            return super().submit(*arguments, **named)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def drive(self, spec: LatencySpec, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Drive an episode for each seed; return the results without their actions.

        Raises UntoldError if the environment does not report how each drive ended.
        """
        results = list(self.map(partial(_drive, spec), seeds))
        self._ends.update(result.outcome for result in results)
        # A step limit is a timeout once any other drive has reported its end.
        if UNKNOWN in self._ends or len(self._ends) == 1:
            raise UntoldError("no outcome or is_success in info tells whether it succeeded")
        return [
            replace(result, outcome=TIMEOUT) if result.outcome == TRUNCATED else result
            for result in results
        ]


_mine: list[Any] = []  # In a process of the pool: environment, driver, condition


def _load(policy: str, env: str, condition: str, key: str | None, period_s: float | None) -> Any:
    environment = make_environment(env, condition, period_s=period_s)
    return environment, *load_driver(policy, environment, key)


def _begin(*task: Any) -> None:
    threading.Thread(target=die_with_parent, daemon=True).start()
    set_threads(1)
    environment, driver, _ = _load(*task)
    _mine[:] = environment, driver, task[2]


def _drive(spec: LatencySpec, seed: int) -> EpisodeResult:
    env, driver, condition = _mine
    (result,) = drive_episodes(env, driver, [seed], condition, latency=spec)
    return replace(result, actions=[])


def _swept(about: Mapping[str, Any], search: Search) -> dict[str, Any]:
    """Return the tried networks in the form of a campaign's report."""
    axes, drives = [], [row["drives"] for row in search.tried.values()]
    for name in AXES:
        alone = {row["at"].get(name, 0.0): spec for spec, row in search.tried.items()
                 if {name}.issuperset(row["at"])}  # fmt: skip
        title, _, unit = name.rpartition("_")
        edge = search.edges.get(name, {})
        found = [edge[end] for end in ("limit", "breaks_at") if edge.get(end) is not None]
        values, specs = map(list, zip(*sorted(alone.items()), strict=True))
        named = {"title": title.replace("_", " "), "unit": unit, "edges": found}
        axes.append({**named, "values": values, "specs": specs})
    return {
        **about, "scenario": about["env"], "axes": axes, "runs": f"{min(drives)} to {max(drives)}",
        "budget": {"target_success": about["promised_success"]},
        "rows": {
            spec: {"success": success_estimate(row["successes"], row["drives"])._asdict()}
            for spec, row in search.tried.items()
        },
    }  # fmt: skip


def draw_axes(swept: Mapping[str, Any]) -> Figure:
    """Draw a panel for each axis of a campaign's part ``latency``, or of what `_swept` returns."""
    axes = swept["axes"]
    rows, columns = math.ceil(len(axes) / PANELS), min(PANELS, len(axes))
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten().tolist()
    for panel, axis in zip(panels, axes, strict=False):
        values = axis["values"]
        estimates = [swept["rows"][spec]["success"] for spec in axis["specs"]]
        panel.plot(values, [each["value"] for each in estimates], "o-", ms=3.5)
        low, high = ([each[end] for each in estimates] for end in ("low", "high"))
        panel.fill_between(values, low, high, alpha=0.2, linewidth=0)
        for edge, color in zip(axis.get("edges", ()), ("C2", "C3"), strict=False):
            panel.axvline(edge, color=color, lw=0.8)
        panel.axhline(swept["budget"]["target_success"], color="0.4", lw=0.8, linestyle="--")
        panel.set_xlabel(f"{axis['title']}, {axis['unit']}", fontsize=9)
        panel.grid(alpha=0.3)
        panel.set_ylim(-0.03, 1.03)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.supylabel("success")
    drives = f"{swept['scenario']}, {swept['condition']}, {swept['runs']} episodes a point"
    figure.suptitle(f"{Path(swept['policy']).stem}: {drives}; Wilson's 95 % interval; target")
    return figure
