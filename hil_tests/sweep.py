"""The latency campaign: along each axis one thing about the network gets worse, each way.

Every network is driven with the same seeds, in virtual time. The budget is the largest value of
each axis up to which the policy holds a share of successes.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bridge.network import parse_spec
from bridge.outcomes import COLLISION, GOAL
from bridge.report import EpisodeResult, ProgressBar, markdown_table
from bridge.statistics import Estimate, mean_estimate, success_estimate
from hil_tests.drivers import Drivers

PANELS = 3  # In a row


@dataclass(frozen=True)
class Axis:
    """What gets worse along one line of a sweep, step by step."""

    name: str
    title: str
    unit: str
    values: tuple[float, ...]  # Ascending
    pattern: str
    """The specification of a point, which is its name in the report; ``{}`` is the value."""
    base: str  # The specification at value 0, and what the line is measured on
    limit: str  # How the budget's sentence names the limit; ``{}`` is the value with its unit

    def spec(self, value: float) -> str:
        """Return the specification at a value."""
        return self.pattern.format(f"{value:g}") if value else self.base

    @property
    def specs(self) -> list[str]:
        """Return the specifications of all values."""
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

Found = Mapping[str, Any]  # A part of a report's JSON
Rows = Mapping[str, Found]  # The report's rows by their specification


def run_latency(
    arguments: argparse.Namespace, policy: Path, axes: Sequence[Axis]
) -> dict[str, Any]:
    """Drive every network of the axes; return the report's part ``latency``."""
    specs = list(dict.fromkeys(spec for axis in axes for spec in axis.specs))
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    task = arguments.scenario, arguments.condition
    rows = {}
    with (
        Drivers(str(policy), *task, arguments.public_key, arguments.jobs) as drivers,
        ProgressBar("networks", len(specs)) as bar,
    ):
        for spec in specs:
            rows[spec] = make_row(spec, drivers.drive(parse_spec(spec), seeds))
            bar.advance({"network": spec})
    told = ("name", "title", "unit", "values", "specs")
    return {
        "policy": str(policy),
        "policy_id": drivers.policy_id,
        "scenario": arguments.scenario,
        "condition": arguments.condition,
        "seed": arguments.seed,
        "runs": arguments.runs,
        "clock": "lockstep",
        "axes": [{name: getattr(axis, name) for name in told} for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, arguments.target, policy.stem),
    }


def make_row(spec: str, results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Sum up the drives of a network, with intervals of 95 %: Wilson's of the success, Student's
    of the distance.
    """
    count, outcomes = len(results), Counter(result.outcome for result in results)
    of_each = ("seed", "outcome", "distance_m", "time_s", "steps")
    return {
        "spec": spec,
        "episodes": count,
        "success": interval(success_estimate(outcomes[GOAL], count)),
        "outcomes": dict(outcomes),
        "surviving_distance_m": interval(mean_estimate([each.distance_m for each in results])),
        "episode_time_s": sum(each.time_s for each in results) / count,
        "collision_rate": outcomes[COLLISION] / count,
        "per_episode": [{name: getattr(each, name) for name in of_each} for each in results],
    }


def interval(estimate: Estimate) -> dict[str, float]:
    """Return an estimate as a report has it."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def limit_of(axis: Axis, rows: Rows, target: float) -> float | None:
    """Return the largest value up to which every tested one is at the target; None: not even 0."""
    holds = takewhile(lambda v: rows[axis.spec(v)]["success"]["value"] >= target, axis.values)
    return max(holds, default=None)


def budget(axes: Sequence[Axis], rows: Rows, target: float, name: str) -> dict[str, Any]:
    """Return each axis's limit, whether it is only the end of what was tested, and a sentence."""
    limits = {axis.name: limit_of(axis, rows, target) for axis in axes}
    open_ended = {axis.name: limits[axis.name] == axis.values[-1] for axis in axes}
    parts = []
    for axis in axes:
        limit = limits[axis.name]
        if limit is None:
            parts.append(f"no {axis.name} (on {axis.base} alone it is below)")
        else:
            most = " (the most that was tested)" if open_ended[axis.name] else ""
            parts.append(axis.limit.format(f"{limit:g} {axis.unit}") + most)
    return {
        "target_success": target,
        "limits": limits,
        "up_to_the_largest_tested": open_ended,
        "sentence": f"{name} holds at least {100 * target:g}% success up to {', '.join(parts)}; "
        "one at a time.",
    }


COLUMNS = {
    "episodes": "{episodes}",
    "success (95 %)": "{success[value]:.0%} ({success[low]:.0%} to {success[high]:.0%})",
    "collisions": "{collision_rate:.0%}",
    "surviving distance, m (95 %)": "{surviving_distance_m[value]:.2f} "
    "({surviving_distance_m[low]:.2f} to {surviving_distance_m[high]:.2f})",
    "time, s": "{episode_time_s:.2f}",
}


def render_latency(latency: Found) -> str:
    """Render the budget's sentence, the picture, and a table for each axis, as Markdown."""
    lines = [
        latency["budget"]["sentence"],
        "",
        "A limit is the largest tested value up to which, at every tested value, the share of "
        f"successes over {latency['runs']} episodes (the same seeds in every row) is at the "
        "target; nothing is interpolated. The drives are in virtual time.",
        "",
        *(f"![{name}]({path})\n" for name, path in latency["figures"].items()),
    ]
    for axis in latency["axes"]:
        rows = [
            (f"{value:g} {axis['unit']}", *(text.format(**row) for text in COLUMNS.values()))
            for value, row in zip(
                axis["values"], map(latency["rows"].get, axis["specs"]), strict=True
            )
        ]
        title = f"### {axis['title'][0].upper()}{axis['title'][1:]}"
        lines += [title, "", *markdown_table(("value", *COLUMNS), rows)]
    return "\n".join(lines)


def draw_axes(swept: Found) -> Figure:
    """Draw a panel for each axis of a report's part ``latency``."""
    axes, name = swept["axes"], Path(swept["policy"]).stem
    rows, columns = math.ceil(len(axes) / PANELS), min(PANELS, len(axes))
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten().tolist()
    for panel, axis in zip(panels, axes, strict=False):
        values = axis["values"]
        estimates = [swept["rows"][spec]["success"] for spec in axis["specs"]]
        panel.plot(values, [each["value"] for each in estimates], "o-", ms=3.5, label=name)
        low, high = ([each[end] for each in estimates] for end in ("low", "high"))
        panel.fill_between(values, low, high, alpha=0.2, linewidth=0)
        panel.set_xlabel(f"{axis['title']}, {axis['unit']}", fontsize=9)
        panel.grid(alpha=0.3)
        target = swept["budget"]["target_success"]
        panel.axhline(target, color="0.4", lw=0.8, linestyle="--", label=f"{100 * target:g}%")
        panel.set_ylim(-0.03, 1.03)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.supylabel("success")
    drives = f"{swept['scenario']}, {swept['condition']}, {swept['runs']} episodes a point"
    title = f"{drives}; bands: Wilson's 95 % interval"
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, title=title, frameon=False)
    return figure
