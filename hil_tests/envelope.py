"""``python -m hil_tests envelope``: find the smallest networks that break a policy.

Each axis is searched alone, then all together. A point is driven until a sequential test has
decided, in process and in virtual time, which is the drive over the wire to the bit
(`tests/test_loop.py`). Every point drives the same seeds.

What is written holds the region in which the policy keeps its promise. With limits L and measured
values x, a network is inside where::

    every x <= L   and   the sum of x / L <= joint        (0 / 0 counts as 0)

This is conservative where failures of several kinds add up and each grows at least in proportion:
then a mixture of limits, each at its share, fails no more than one of them alone. ``joint`` starts
at 1, and is lowered to the least sum at which a mixture that was tried (each pair in equal shares,
and all together) kept the promise. ``box`` needs only that less is no worse: where every
x <= box L, the promise is kept, too.

A run of one lost message is no burst (x = 0): it belongs to the loss. The longest run of a window
is at least its mean run, so comparing it with ``burst_messages``, a mean, is conservative.
``jitter_ms`` is the smaller of the limits with a normal and with a long (Pareto) tail.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Annotated, Any

import msgspec

from bridge.network import DirectionSpec, LatencySpec, Outage, parse_spec
from bridge.outcomes import GOAL
from bridge.statistics import success_estimate
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError, name_in_file, read_json
from hil_tests.drivers import Drivers
from trainer.environments import CONDITIONS
from trainer.util import kept

HOLDS, BREAKS, BETWEEN = "holds", "breaks", "between"
ZONE = 0.7
"""The test tells the promise from 0.7 times more, and 0.7 times fewer, failures: for 95 %, from
98.5 % and from 91.5 %."""
TRIES = 8  # So many points an axis tries, about; the error of each is that much smaller
MOST_FAILURES = 50  # At the promise: a point is left undecided after the drives that have so many
AT_ONCE = 16  # Drives between two looks at whether a point is decided
FRESH = 1_000_000  # So far from the seeds of the search are those that confirm it
OUTAGE_EVERY_S, OUTAGE_START_S = 3.0, 0.97  # Off the ticks, so that rounding decides nothing
BURST_PERCENT = 5.0  # Share of the messages in bad stretches
MOST_LOSS_PERCENT = 99.0  # In bursts all is lost; between them it must be less
JITTER_FLOOR = 2.0  # Delay below so many standard deviations of jitter would be cut at zero
SCALE = 20  # Steps of the way to the corner of all limits

AXES = {
    "delay_ms": (1000.0, 10.0),  # One way, each way; so is all below
    "jitter_ms": (200.0, 5.0),  # Standard deviation, normal
    "tail_jitter_ms": (200.0, 5.0),  # The same, Pareto
    "loss_percent": (50.0, 1.0),  # Independent
    "burst_messages": (10.0, 0.5),  # Mean run of lost messages; below 1: none
    "outage_s": (2.0, 0.05),  # Both ways at once, every 3 s
}
"""Each axis's largest value, and its resolution."""
Point = Mapping[str, float]  # Axis -> value; 0 where it is missing
Ray = Callable[[int], Point]  # The point of a step; 0 is a perfect network
Drive = Callable[[LatencySpec, Sequence[int]], Sequence[bool]]
"""Drives these seeds behind a network; for each, whether it succeeded."""


def network(at: Point) -> LatencySpec:
    """Return the network of a point, the same each way."""
    delay_ms, jitter_ms, tail_ms, loss, burst, outage_s = (at.get(name, 0.0) for name in AXES)
    outage_s = min(outage_s, OUTAGE_EVERY_S - AXES["outage_s"][1])  # One must end.
    spread_ms, has_bursts, loss = jitter_ms or tail_ms, burst >= 1.0, min(loss, MOST_LOSS_PERCENT)
    settings: dict[str, Any] = {
        "delay_ms": max(delay_ms, JITTER_FLOOR * spread_ms),
        "jitter_ms": spread_ms,
        "tail": "pareto" if tail_ms else "normal",
        "loss_percent": loss + has_bursts * BURST_PERCENT * (1.0 - loss / 100.0),
        "clear_loss_percent": loss * has_bursts,
        "burst_messages": burst * has_bursts,
    }
    rounded: dict[str, Any] = {
        key: round(x, 6) if isinstance(x, float) else x for key, x in settings.items()
    }
    outages = (Outage(round(outage_s, 6), OUTAGE_START_S, OUTAGE_EVERY_S),) if outage_s else ()
    one_way = DirectionSpec(**rounded, outages=outages)
    return LatencySpec(one_way, one_way)


class SequentialTest:
    """Decides by few drives whether the share of successes is above or below a promise.

    Two of Wald's sequential probability ratio tests (1945, Sequential tests of statistical
    hypotheses, Annals of Mathematical Statistics 16(2)) on the same drives, as Sobel and Wald
    (1949, the same journal, 20(4)) choose one of three hypotheses: the promise against ``ZONE``
    fewer failures, and against ``ZONE`` more. BETWEEN: neither could be shown.
    """

    def __init__(self, promise: float, confidence: float) -> None:
        failing, error = 1.0 - promise, 1.0 - confidence
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
        """Count a drive; return the verdict, None while there is none."""
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
    """Looks for edges, and keeps the verdict of every point that was tried.

    ``drive`` is called with the next seeds, from ``seed`` on and ``at_once`` at a time, until a
    point is decided. ``confidence`` is that of a statement about an axis.
    """

    def __init__(
        self, drive: Drive, promise: float, confidence: float, seed: int = 0, at_once: int = AT_ONCE
    ) -> None:
        self._drive, self._seed, self._at_once = drive, seed, at_once
        self._new_test = partial(SequentialTest, promise, confidence)
        self.tried: dict[str, dict[str, Any]] = {}

    def verdict(self, at: Point) -> str:
        """Drive a point until it is decided; return HOLDS, BREAKS or BETWEEN."""
        spec = network(at)
        if str(spec) not in self.tried:
            test, verdict = self._new_test(), None
            while verdict is None:
                first = self._seed + test.drives
                for success in self._drive(spec, range(first, first + self._at_once)):
                    verdict = verdict or test.add(success)
            found = {"verdict": verdict, "drives": test.drives, "successes": test.successes}
            self.tried[str(spec)] = found
            print(f"{spec}: {verdict} ({test.successes} of {test.drives})", file=sys.stderr)
        return str(self.tried[str(spec)]["verdict"])

    def holds_up_to(self, ray: Ray, most: int) -> int:
        """Return the largest step up to which every tried one holds, by bisection from 0.

        Less may be worse: half of it is tried, too.
        """
        edge = self._bisect(ray, 0, most, (HOLDS,))[0]
        if edge > 1 and self.verdict(ray(edge // 2)) != HOLDS:
            edge = self._bisect(ray, 0, edge // 2, (HOLDS,))[0]
        return edge

    def edge(self, ray: Ray, most: int) -> dict[str, Any]:
        """Return the largest step that holds, the smallest beyond it that breaks, both networks.

        None where none breaks. The edge lies below the least step known to break.
        """
        inside = self.holds_up_to(ray, most)
        names = {k: str(network(ray(k))) for k in range(inside + 1, most + 1)}
        broken = [k for k in names if self.tried.get(names[k], {}).get("verdict") == BREAKS]
        beyond = self._bisect(ray, inside, min(broken, default=most), (HOLDS, BETWEEN))[1]
        outside = beyond if beyond <= most else None
        found = {"steps": (inside, outside), "inside": str(network(ray(inside)))}
        return {**found, "outside": None if outside is None else str(network(ray(outside)))}

    def _bisect(self, ray: Ray, low: int, most: int, is_low: tuple[str, ...]) -> tuple[int, int]:
        """Return neighbours of which the lower is low; the most is tried first, ``low`` never."""
        middle, high = most, most + 1
        while high - low > 1:
            low, high = (middle, high) if self.verdict(ray(middle)) in is_low else (low, middle)
            middle = (low + high) // 2
        return low, high


def find_region(search: Search) -> dict[str, Any]:
    """Return limits, ``joint`` and ``box`` (module docstring), and the edges.

    Raises UserError where the promise is not kept without a network.
    """
    if search.verdict({}) != HOLDS:
        raise UserError("the promise is not kept even on a perfect network: lower --promise")

    def of_axis(name: str) -> dict[str, Any]:
        most, step = AXES[name]
        found = search.edge(lambda k: {name: k * step}, round(most / step))
        limit, breaks_at = (k and round(k * step, 6) for k in found.pop("steps"))
        return {"limit": limit, "breaks_at": breaks_at, **found}

    edges = {name: of_axis(name) for name in AXES}
    limits = {name: edge["limit"] for name, edge in edges.items()}
    limits["burst_messages"] *= limits["burst_messages"] >= 1.0
    worse, other = sorted(("jitter_ms", "tail_jitter_ms"), key=limits.__getitem__)
    corner = {name: limit for name, limit in limits.items() if limit and name != other}

    def mixture(names: Sequence[str]) -> Ray:
        return lambda k: {name: corner[name] * k / SCALE for name in names}

    edges["together"] = search.edge(mixture(list(corner)), 2 * SCALE)
    held = [search.holds_up_to(mixture(pair), SCALE // 2) for pair in combinations(corner, 2)]
    box = min(1.0, edges["together"].pop("steps")[0] / SCALE)
    joint = min(1.0, len(corner) * box, *(2 * k / SCALE for k in held))
    tail_ms, limits["jitter_ms"] = limits.pop("tail_jitter_ms"), limits[worse]
    return {"limits": limits, "joint": joint, "box": box, "tail_jitter_ms": tail_ms, "edges": edges}


class EdgeNetworks(msgspec.Struct):
    """The networks on both sides of an edge; None outside where no network breaks the policy."""

    inside: str
    outside: str | None


class Known(msgspec.Struct):
    """What a file of an envelope holds of what is needed to confirm it."""

    policy_id: str
    policy: str
    env: str
    condition: str
    promised_success: float
    confidence: float
    edges: Annotated[dict[str, EdgeNetworks], msgspec.Meta(min_length=1)]


def read_known(path: str) -> Known:
    """Read an envelope's file; UserError where it holds none, or nothing to confirm."""
    value = read_json(path, "envelope")
    try:
        known = msgspec.convert(value, Known)
        for edge in known.edges.values():
            for spec in (edge.inside, edge.outside or "none"):
                parse_spec(spec)
    except (msgspec.ValidationError, UserError) as error:
        what = "no envelope of hil_tests envelope, with edges to confirm"
        raise UserError(f"{path} is {what}: {error}") from None
    if known.condition not in CONDITIONS:
        raise UserError(f"{path}: there is no condition {known.condition!r}")
    return known


def confirm(drive: Drive, known: Known, seeds: range) -> dict[str, Any]:
    """Drive every edge's two networks; report whether inside kept the promise, outside not."""
    rows = []
    for name, edge in known.edges.items():
        for side, spec in (("inside", edge.inside), ("outside", edge.outside)):
            if spec is None:
                continue
            successes = sum(drive(parse_spec(spec), seeds))
            found = success_estimate(successes, len(seeds))
            as_told = (found.value >= known.promised_success) == (side == "inside")
            rows.append({
                "edge": name, "side": side, "network": spec, "successes": successes,
                "share": found.value, "low": found.low, "high": found.high, "as_told": as_told,
            })  # fmt: skip
            print(f"{name} {side}: {found.value:.1%} {spec}", file=sys.stderr)
    return {"runs": len(seeds), "rows": rows, "confirmed": all(row["as_told"] for row in rows)}


def run(arguments: argparse.Namespace) -> int:
    """Find an envelope, or confirm one; return 0, or 1 where an edge is not confirmed."""
    check_writable(arguments.out)
    began_s = time.monotonic()
    env, name, known = arguments.env or "left_turn", arguments.policy, None
    told: Any = arguments
    if arguments.confirm:
        told = known = read_known(arguments.confirm)
        said = f"{arguments.confirm} is of"
        env = arguments.env or name_in_file(known.env, said, "--env")
        name = name or name_in_file(known.policy, said, "--policy")
    name = name or kept(f"results/policies/{env}.onnx")
    promise = known.promised_success if known else arguments.promise
    task = (name, env, told.condition, arguments.public_key, arguments.jobs)
    with sigterm_as_interrupt(), Drivers(*task) as drivers:
        if known and known.policy_id != drivers.policy_id:
            raise UserError(f"{arguments.confirm} is of another policy than {name}")

        def drive(spec: LatencySpec, seeds: Sequence[int]) -> list[bool]:
            return [result.outcome == GOAL for result in drivers.drive(spec, seeds)]

        if known:
            first = arguments.seed + FRESH
            found = confirm(drive, known, range(first, first + arguments.runs))
        else:
            at_once = max(drivers.jobs, AT_ONCE)
            search = Search(drive, promise, told.confidence, arguments.seed, at_once)
            found = {**find_region(search), "tried": search.tried}
    report = {
        "schema": 1, "policy_id": drivers.policy_id, "policy": name, "env": env,
        "condition": told.condition, "promised_success": promise, "confidence": told.confidence,
        "seed": arguments.seed, "control_period_s": drivers.control_period_s, **found,
        "drives": drivers.driven, "seconds": round(time.monotonic() - began_s, 1),
        "command": f"python -m hil_tests {shlex.join(sys.argv[1:])}",
    }  # fmt: skip
    write_json_out(arguments.out, report)
    shown = ("limits", "joint", "box", "confirmed", "drives", "seconds")
    print(", ".join(f"{key} {report[key]}" for key in shown if key in report))
    return 0 if report.get("confirmed", True) else 1
