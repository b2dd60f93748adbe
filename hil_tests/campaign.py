"""``python -m hil_tests campaign``: every fault, and every network of the axes, in one report.

The report is JSON, and beside it Markdown for people, with a table for each part and a picture.
"""

from __future__ import annotations

import argparse
import fnmatch
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bridge.report import ProgressBar, markdown_table
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.util import UserError
from hil_tests.faults.run import run_faults
from hil_tests.faults.table import ROWS, Row
from hil_tests.sweep import NETWORK_AXES, Axis, draw_axes, render_latency, run_latency
from trainer.training.metrics import write_figure
from trainer.util import cores, kept

SHOWN_WRONG = 5
ENDS = ("_ms", "_limit_ms")


@sigterm_as_interrupt()  # whoever ends a campaign ends its processes
def run(arguments: argparse.Namespace) -> int:
    """Run both parts or one; return 0, or 1 where a fault was not met as it should be."""
    out = Path(arguments.out)
    markdown, picture = out.with_suffix(".md"), out.with_name(f"{out.stem}_success.png")
    if markdown == out:
        raise UserError(f"--out {out} is for the JSON; the Markdown is written beside it")
    check_writable(out)
    check_writable(markdown)
    axes, rows = choose(arguments.rows, arguments.only)
    policy = Path(arguments.policy or kept(f"results/policies/{arguments.scenario}.onnx"))
    result: dict[str, Any] = {"command": f"python -m hil_tests {shlex.join(sys.argv[1:])}"}
    text = [f"# Campaign: {policy.name}, {arguments.scenario}", "", f"`{result['command']}`", ""]
    if axes:
        latency = run_latency(arguments, policy, axes)
        write_figure(draw_axes(latency), picture)
        result["latency"] = {**latency, "figures": {"success": picture.name}}
        text += ["## Latency", "", render_latency(result["latency"])]
        print(latency["budget"]["sentence"])
    passed = True
    if rows:
        result["faults"] = found = _run_faults(arguments, rows, policy)
        text += ["## Faults", "", render_faults(found)]
        passed = found["passed"]
    write_json_out(out, result)
    write_atomic(markdown, ("\n".join(text).rstrip() + "\n").encode())
    print(f"{out} and {markdown}")
    return 0 if passed else 1


def _run_faults(arguments: argparse.Namespace, rows: list[Row], policy: Path) -> dict[str, Any]:
    with ProgressBar("faults", arguments.tries * len(rows)) as bar:
        found = run_faults(
            rows, arguments.tries, policy, lambda row: bar.advance({"row": row}),
            arguments.jobs or cores(), arguments.public_key,
        )  # fmt: skip
    for row in found["rows"]:
        for kind in ("wrong", "unsafe", "crashes"):
            for what in row[kind][:SHOWN_WRONG]:
                print(f"{row['name']}: {kind}: {what}")
    print("Every fault was met." if found["passed"] else "Not every fault was met.")
    return found


def choose(names: str | None, only: str | None) -> tuple[list[Axis], list[Row]]:
    """Return the latency axes and the faults of these names or patterns (``hunter_*``), in order.

    Raises UserError where a name fits none.
    """
    axes = NETWORK_AXES if only != "faults" else ()
    faults = ROWS if only != "latency" else ()
    known, chosen = [row.name for row in (*axes, *faults)], set[str]()
    for name in names.split(",") if names else ["*"]:
        if not (found := fnmatch.filter(known, name)):
            kind = " or ".join(["latency axis"] * bool(axes) + ["fault"] * bool(faults))
            raise UserError(f"no {kind} {name!r}; choose from {', '.join(known)}")
        chosen.update(found)
    wanted = [axis for axis in axes if axis.name in chosen]
    return wanted, [row for row in faults if row.name in chosen]


def render_faults(report: Mapping[str, Any]) -> str:
    """Render a row for each fault; reaction and recovery as min / median / max over its tries."""
    head = ("fault", "expected", "tries", "reaction, ms", "limit", "recovery, ms", "limit",
            "verdict")  # fmt: skip
    rows = []
    for row in report["rows"]:
        again = f" (+{row['disturbed']} again)" if row["disturbed"] else ""
        times = (_ms(row[f"{kind}{end}"]) for kind in ("reaction", "recovery") for end in ENDS)
        tries = f"{row['tries']}{again}"
        rows.append((row["done"], row["expected"], tries, *times, fault_verdict(row)))
    end = (
        f"{report['crashes']} crashes and {report['unsafe_commands']} unsafe commands "
        "over the whole campaign."
    )
    return "\n".join([*markdown_table(head, rows), end])


def fault_verdict(row: Mapping[str, Any]) -> str:
    """Return ``met``, or what was not."""
    late = {name: row[f"{name}_late"] for name in ("reactions", "recoveries")}
    faults = [f"{count} {name} late" for name, count in late.items() if count]
    faults += [f"{len(row[name])} {name}" for name in ("unsafe", "crashes", "wrong") if row[name]]
    counted = sum(row["rejected"].values())
    met = f"met, {counted:,} rejected and counted" if counted else "met"
    return "MISSED: " + ", ".join(faults) if faults else met


def _ms(found: Mapping[str, float] | float | None) -> str:
    values = [] if found is None else [found] if isinstance(found, float) else found.values()
    return " / ".join(f"{value:.0f}" for value in values) or "-"
