"""``python -m hil_tests campaign``: every fault, and every network of the axes, in one report.

The report is JSON, and beside it Markdown for people, with tables and pictures.
"""

from __future__ import annotations

import argparse
import fnmatch
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bridge.progress import ProgressBar
from bridge.report import markdown_table
from edge_runtime.cli import (
    sigterm_as_interrupt,
)
from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests import sweep
from hil_tests.faults.rows import ROWS, Row
from hil_tests.faults.run import run_faults
from hil_tests.sweep import Found
from trainer.pictures import write_figure
from trainer.util import cores, kept

SHOWN_WRONG = 5
COLUMNS = 3


@sigterm_as_interrupt()  # whoever ends a campaign ends its processes
def run(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where a fault was not met as it should be."""
    out = Path(arguments.out)
    check_report(out)
    axes, rows = choose(arguments.rows, arguments.only)
    jobs = arguments.jobs or cores()
    command = f"python -m hil_tests {shlex.join(sys.argv[1:])}"
    result: dict[str, Any] = {"command": command}
    policy = Path(arguments.policy or kept(f"results/policies/{arguments.scenario}.onnx"))
    text = [f"# Campaign: {policy.name}, {arguments.scenario}", "", f"`{command}`", ""]
    if axes:
        latency = run_latency(_task(arguments, policy), axes, arguments.target, jobs, out)
        result["latency"] = latency
        text += ["## Latency", "", render_latency(latency)]
        print(latency["budget"]["sentence"])
    if rows:
        with ProgressBar("faults", arguments.tries * len(rows)) as bar:
            found = run_faults(
                rows, arguments.tries, policy, lambda row: bar.advance({"row": row}), jobs,
                arguments.public_key,
            )  # fmt: skip
        result["faults"] = found
        text += ["## Faults", "", render_faults(found)]
        for row in found["rows"]:
            for kind in ("wrong", "unsafe", "crashes"):
                for what in row[kind][:SHOWN_WRONG]:
                    print(f"{row['name']}: {kind}: {what}")
        print("Every fault was met." if found["passed"] else "Not every fault was met.")
    write_report(out, result, text)
    return 0 if not rows or result["faults"]["passed"] else 1


def choose(names: str | None, only: str | None) -> tuple[list[sweep.Axis], list[Row]]:
    """The latency axes and the faults of these names or patterns (``hunter_*``), in their order.

    UserError where one fits none.
    """
    axes = sweep.NETWORK_AXES if only != "faults" else ()
    faults = ROWS if only != "latency" else ()
    known, chosen = [row.name for row in (*axes, *faults)], set[str]()
    for name in names.split(",") if names else ["*"]:
        if not (found := fnmatch.filter(known, name)):
            kind = " or ".join(["latency axis"] * bool(axes) + ["fault"] * bool(faults))
            raise UserError(f"no {kind} {name!r}; choose from {', '.join(known)}")
        chosen.update(found)
    wanted = [axis for axis in axes if axis.name in chosen]
    return wanted, [row for row in faults if row.name in chosen]


def _task(arguments: argparse.Namespace, policy: Path) -> sweep.Task:
    """UserError where the policy does not load; its signature is the edge runtime's to check."""
    loaded = load_policy(str(policy), arguments.public_key, allow_unsigned=True)
    return sweep.Task(
        policy, loaded.policy_id, arguments.scenario, arguments.condition, arguments.seed,
        arguments.runs, arguments.public_key, loaded.manifest.control_period_s,
    )  # fmt: skip


def run_latency(
    task: sweep.Task, axes: Sequence[sweep.Axis], target: float, jobs: int, out: Path
) -> dict[str, Any]:
    """Drive every network of the axes; the report's part ``latency``."""
    specs = list(dict.fromkeys(spec for axis in axes for spec in axis.specs))
    keep = out.with_name(f"{out.stem}_rows")
    found = sweep.drive_all(task, specs, jobs, keep)
    rows = {spec: sweep.make_row(spec, parts) for spec, parts in found.items()}
    driven_s, wall_s = (sum(row[name] for row in rows.values()) for name in ("driven_s", "wall_s"))
    told = ("name", "title", "unit", "values", "specs")
    latency = {
        **task.facts(),
        "clock": "lockstep",
        "axes": [{name: getattr(axis, name) for name in told} for axis in axes],
        "rows": rows,
        "budget": sweep.budget(axes, rows, target, task.policy.stem),
        "faster_than_real_time": driven_s / wall_s,
    }
    picture = out.with_name(f"{out.stem}_success.png")
    write_figure(draw_axes(latency), picture)
    return {**latency, "figures": {"success": picture.name}}


def check_report(out: Path) -> None:
    """Raise UserError now, before the long work, if `write_report` would fail after it."""
    if out.suffix == ".md":
        raise UserError(f"--out {out} is for the JSON; the Markdown is written beside it")
    check_writable(out)
    check_writable(out.with_suffix(".md"))


def write_report(out: Path, report: Found, lines: Sequence[str]) -> None:
    """Write ``out`` and, with its ``lines``, the Markdown beside it; say where."""
    write_json_out(out, report)
    markdown = out.with_suffix(".md")
    write_atomic(markdown, ("\n".join(lines).rstrip() + "\n").encode())
    print(f"{out} and {markdown}")


def render_faults(report: Found) -> str:
    """A row for each fault; reaction and recovery as min / median / max over its tries."""
    head = ("fault", "expected", "tries", "reaction, ms", "limit", "recovery, ms", "limit",
            "verdict")  # fmt: skip
    rows = []
    for row in report["rows"]:
        again = f" (+{row['disturbed']} again)" if row["disturbed"] else ""
        rows.append((
            row["done"], row["expected"], f"{row['tries']}{again}",
            _numbers(row["reaction_ms"], 0), _number(row["reaction_limit_ms"], 0),
            _numbers(row["recovery_ms"], 0), _number(row["recovery_limit_ms"], 0),
            fault_verdict(row),
        ))  # fmt: skip
    end = (
        f"{report['crashes']} crashes and {report['unsafe_commands']} unsafe commands "
        "over the whole campaign."
    )
    return "\n".join([*markdown_table(head, rows), end])


def fault_verdict(row: Found) -> str:
    """``met``, or what was not."""
    late = {name: row[f"{name}_late"] for name in ("reactions", "recoveries")}
    faults = [f"{count} {name} late" for name, count in late.items() if count]
    faults += [f"{len(row[name])} {name}" for name in ("unsafe", "crashes", "wrong") if row[name]]
    counted = sum(row["rejected"].values())
    met = f"met, {counted:,} rejected and counted" if counted else "met"
    return "MISSED: " + ", ".join(faults) if faults else met


_OF_A_ROW = {
    "episodes": "{episodes}",
    "success (95 %)": "{success[value]:.0%} ({success[low]:.0%} to {success[high]:.0%})",
    "collisions": "{collision_rate:.0%}",
    "surviving distance, m (95 %)": "{way[value]:.2f} ({way[low]:.2f} to {way[high]:.2f})",
    "time, s": "{episode_time_s:.2f}",
    "latency p50 / p99, ms": "{latency}",
    "safe stops an episode": "{safe_stops_per_episode:.2f}",
    "ticks without a new command": "{ticks_without_new_command:.0%}",
}


def render_latency(latency: Found) -> str:
    """The budget's sentence, pictures, and a table for each axis."""
    lines = [
        latency["budget"]["sentence"],
        "",
        "A limit is the largest tested value up to which, at every tested value, the share of "
        f"successes over {latency['runs']} episodes (the same seeds in every row) is at the "
        f"target; nothing is interpolated. Clock: {latency['clock']}, "
        f"{latency['faster_than_real_time']:.1f} times real time in each worker, the start of "
        "each simulator included.",
        "",
        *(f"![{name}]({path})\n" for name, path in latency["figures"].items()),
    ]
    for axis in latency["axes"]:
        rows = []
        for value, spec in zip(axis["values"], axis["specs"], strict=True):
            row = latency["rows"][spec]
            told = {"way": row["surviving_distance_m"], "latency": _numbers(row["latency_ms"], 1)}
            cells = (text.format(**row, **told) for text in _OF_A_ROW.values())
            rows.append((f"{value:g} {axis['unit']}", *cells))
        title = f"### {axis['title'][0].upper()}{axis['title'][1:]}"
        lines += [title, "", *markdown_table(("value", *_OF_A_ROW), rows)]
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _numbers(found: Mapping[str, float | None] | None, digits: int) -> str:
    return " / ".join(_number(value, digits) for value in found.values()) if found else "-"


def draw_axes(swept: Found) -> Figure:
    """A panel for each axis of a report's part."""
    axes, name = swept["axes"], Path(swept["policy"]).stem
    rows, columns = math.ceil(len(axes) / COLUMNS), min(COLUMNS, len(axes))
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
