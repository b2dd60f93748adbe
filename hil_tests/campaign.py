"""``python -m hil_tests campaign``: inject every fault, test every network, and write a report.

The report is JSON, Markdown and a picture. Each axis worsens one property of the network, each way,
with the same seeds and in virtual time.
"""

from __future__ import annotations

import argparse
import fnmatch
import shlex
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

from bridge.network import parse_spec
from bridge.outcomes import GOAL, success_estimate
from bridge.report import ProgressBar, markdown_table, write_figure
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.util import UserError
from hil_tests.envelope import Drivers, draw_axes
from hil_tests.faults.rows import Row
from hil_tests.faults.run import ROWS, run_faults
from trainer.util import cores, kept

Found = Mapping[str, Any]  # A part of a report's JSON
TARGET = 0.98  # Success that a network within the budget must allow


class Axis(NamedTuple):
    name: str
    title: str
    unit: str
    values: tuple[float, ...]  # Ascending
    pattern: str  # The specification of a point, which is its name in the report
    base: str = "none"  # The specification at value 0

    @property
    def specs(self) -> list[str]:
        return [self.pattern.format(f"{value:g}") if value else self.base for value in self.values]


_LATE = "delay=100ms"
"""Delay below the jitter axes: without it, half of the jitter would be cut off at zero."""
_MS = (0, 10, 20, 40, 60, 80, 100)
AXES = (
    Axis("delay", "delay each way", "ms",
         (0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 400, 500, 750, 1000),
         "delay={}ms"),
    Axis("jitter", "normal jitter (standard deviation) on 100 ms each way", "ms", _MS,
         f"{_LATE},jitter={{}}ms", _LATE),
    Axis("tail", "long-tailed (Pareto) jitter on 100 ms each way", "ms", _MS,
         f"{_LATE},jitter={{}}ms,tail=pareto", _LATE),
    Axis("loss", "independent loss each way", "%", (0, 1, 2, 5, 10, 15, 20, 25, 30, 40),
         "loss={}%"),
    Axis("burst", "loss in bursts of 5 messages each way", "%", (0, 1, 2, 5, 10, 15, 20, 30),
         "loss={}%,burst=5"),
    Axis("outage", "outage every 3 s, both ways", "s",
         (0, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0), "outage={}s/3s@1s"),
)  # fmt: skip


@sigterm_as_interrupt()  # so that a campaign that is ended ends its processes
def run(arguments: argparse.Namespace) -> int:
    """Run both parts or one; return 1 if a fault was missed, else 0."""
    out = Path(arguments.out)
    markdown, picture = out.with_suffix(".md"), out.with_name(f"{out.stem}_success.png")
    check_writable(out)
    axes, rows = choose(arguments.rows, arguments.only)
    policy = Path(arguments.policy or kept(f"results/policies/{arguments.scenario}.onnx"))
    result: dict[str, Any] = {"command": f"python -m hil_tests {shlex.join(sys.argv[1:])}"}
    text = [f"# Campaign: {policy.name}, {arguments.scenario}", "", f"`{result['command']}`", ""]
    passed = True
    if axes:
        result["latency"] = latency = run_latency(arguments, policy, axes)
        write_figure(draw_axes(latency), picture)
        text += ["## Latency", "", f"![success]({picture.name})", "", *render_latency(latency)]
        print(latency["budget"]["sentence"])
    if rows:
        with ProgressBar("faults", arguments.tries * len(rows)) as bar:
            result["faults"] = faults = run_faults(
                rows, arguments.tries, policy, lambda row: bar.advance({"row": row}),
                arguments.jobs or cores(), arguments.public_key,
            )  # fmt: skip
        text += ["## Faults", "", *(lines := render_faults(faults))]
        passed = faults["passed"]
        print("\n".join(line for line in lines if "MISSED" in line or not line.startswith("|")))
    write_json_out(out, result)
    write_atomic(markdown, ("\n".join(text).rstrip() + "\n").encode())
    print(f"{out} and {markdown}")
    return 0 if passed else 1


def choose(names: str | None, only: str | None) -> tuple[list[Axis], list[Row]]:
    """Return the axes and faults of these names or patterns (``hunter_*``); UserError for none."""
    axes, faults = AXES if only != "faults" else (), ROWS if only != "latency" else ()
    known, chosen = [row.name for row in (*axes, *faults)], set[str]()
    for name in names.split(",") if names else ["*"]:
        if not (matches := fnmatch.filter(known, name)):
            raise UserError(f"there is no {name!r}; choose from {', '.join(known)}")
        chosen.update(matches)
    wanted = [axis for axis in axes if axis.name in chosen]
    return wanted, [row for row in faults if row.name in chosen]


def missed_in(row: Found) -> list[str]:
    late = ["late"] * (row["reaction_late"] + row["recovery_late"])
    return [*late, *row["wrong"], *row["unsafe"], *row["crashes"]]


def render_faults(report: Found) -> list[str]:
    """Render a row for each fault; reaction and recovery as min / median / max over its tries."""
    head = ("fault", "expected", "tries", "reaction, ms", "limit", "recovery, ms", "limit",
            "verdict")  # fmt: skip
    rows = []
    for row in report["rows"]:
        tries = f"{row['tries']} (+{row['disturbed']} again)" if row["disturbed"] else row["tries"]
        times = []
        for kind in ("reaction", "recovery"):
            spread, limit = row[f"{kind}_ms"].values(), row[f"{kind}_limit_ms"]
            times.append(" / ".join(f"{value:.0f}" for value in spread) or "-")
            times.append("-" if limit is None else f"{limit:.0f}")
        missed = missed_in(row)
        counted = sum(row["rejected"].values())
        met = f"met, {counted:,} rejected and counted" if counted else "met"
        verdict = f"MISSED {row['name']}: {'; '.join(missed)}" if missed else met
        rows.append((row["done"], row["expected"], tries, *times, verdict))
    crashes, unsafe = report["crashes"], report["unsafe_commands"]
    return [*markdown_table(head, rows), f"{crashes} crashes and {unsafe} unsafe commands."]


def run_latency(
    arguments: argparse.Namespace, policy: Path, axes: Sequence[Axis]
) -> dict[str, Any]:
    specs = list(dict.fromkeys(spec for axis in axes for spec in axis.specs))
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    asked = {name: getattr(arguments, name) for name in ("scenario", "condition", "seed", "runs")}
    task = (str(policy), arguments.scenario, arguments.condition, arguments.public_key)
    rows: dict[str, dict[str, Any]] = {}
    with Drivers(*task, arguments.jobs) as drivers, ProgressBar("networks", len(specs)) as bar:
        for spec in specs:
            results = drivers.drive(parse_spec(spec), seeds)
            outcomes = Counter(result.outcome for result in results)
            success = success_estimate(outcomes[GOAL], len(results))._asdict()  # Wilson, 95 %
            rows[spec] = {"spec": spec, "episodes": len(results), "success": success}
            rows[spec]["outcomes"] = dict(outcomes)
            bar.advance({"network": spec})
    return {
        "policy": str(policy),
        "policy_id": drivers.policy_id,
        **asked,
        "axes": [{**axis._asdict(), "specs": axis.specs} for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, policy.stem),
    }


def budget(axes: Sequence[Axis], rows: Found, name: str) -> dict[str, Any]:
    """Return each axis's limit, and a sentence with all limits.

    A limit is the largest value up to which all tested ones reach the target; None: not even 0.
    """
    limits, parts = {}, []
    for axis in axes:
        points = zip(axis.values, axis.specs, strict=True)
        holds = takewhile(lambda point: rows[point[1]]["success"]["value"] >= TARGET, points)
        limit = max((value for value, _ in holds), default=None)
        limits[axis.name] = limit
        most = " (the most that was tested)" if limit == axis.values[-1] else ""
        value = f"{limit:g} {axis.unit}" if limit is not None else "not even 0"
        parts.append(f"{value}{most} of {axis.title}")
    sentence = f"{name} holds at least {100 * TARGET:g}% success up to {'; '.join(parts)}. "
    return {"target_success": TARGET, "limits": limits, "sentence": f"{sentence}One at a time."}


def render_latency(latency: Found) -> list[str]:
    lines = [latency["budget"]["sentence"], ""]
    for axis in latency["axes"]:
        rows = []
        for value, spec in zip(axis["values"], axis["specs"], strict=True):
            row = latency["rows"][spec]
            interval = "{value:.0%} ({low:.0%} to {high:.0%})".format(**row["success"])
            ends = ", ".join(f"{count} {name}" for name, count in row["outcomes"].items())
            rows.append((f"{value:g} {axis['unit']}", interval, ends))
        head = ("value", "success (95 %)", "episodes")
        lines += [f"### {axis['title']}", "", *markdown_table(head, rows)]
    return lines
