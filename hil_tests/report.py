"""A campaign's report for people: Markdown beside the JSON, with its tables and pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from bridge.report import markdown_table
from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.util import UserError
from hil_tests.sweep import LOOPS, VEHICLE, Found

COLUMNS = 3


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


Cells = Mapping[str, Callable[[Found], str]]  # What is said of something, and how it is read
_OF_A_ROW: Cells = {
    "episodes": lambda row: str(row["episodes"]),
    "success (95 %)": lambda row: share(row["success"]),
    "collisions": lambda row: f"{row['collision_rate']:.0%}",
    "surviving distance, m (95 %)": lambda row: _interval(row["surviving_distance_m"]),
    "time, s": lambda row: f"{row['episode_time_s']:.2f}",
    "latency p50 / p99, ms": lambda row: _numbers(row["latency_ms"], 1),
    "safe stops an episode": lambda row: f"{row['safe_stops_per_episode']:.2f}",
    "ticks without a new command": lambda row: f"{row['ticks_without_new_command']:.0%}",
}
_OF_A_VEHICLE: Cells = {
    "speed error rmse / max, m/s of the vehicle": lambda row: _numbers(row["speed_error_mps"], 3),
    "action error rmse / max": lambda row: ", ".join(
        f"{name} {_numbers(error, 2)}" for name, error in row["action_error"].items()
    ),
    "actuator lag, ms": lambda row: ", ".join(
        f"{name} {_number(lag, 0)}" for name, lag in row["lag_ms"].items()
    ),
    "feedback age p50 / p99, ms": lambda row: _numbers(row["feedback_age_ms"], 1),
    "metres of the vehicle for one of the scenario": lambda row: _number(row["scale"], 3),
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
        rows = [
            (
                f"{value:g} {axis['unit']}",
                *(tell(latency["rows"][spec]) for tell in _OF_A_ROW.values()),
            )
            for value, spec in zip(axis["values"], axis["specs"], strict=True)
        ]
        title = f"### {axis['title'][0].upper()}{axis['title'][1:]}"
        lines += [title, "", *markdown_table(("value", *_OF_A_ROW), rows)]
    return "\n".join(lines)


def comparison_verdict(comparison: Found) -> str:
    """The bar in one sentence."""
    row = comparison["rows"][VEHICLE]
    met = "is met" if comparison["holds"] else "is NOT met"
    return (
        f"With the vehicle in the loop {comparison['scenario']} succeeds in "
        f"{share(row['success'])} of {row['episodes']} episodes: "
        f"the bar of {comparison['target_success']:.0%} {met}."
    )


def render_comparison(comparison: Found) -> str:
    """The verdict, a column for each loop, and what the vehicle was like."""
    loops = [comparison["rows"][loop] for loop in LOOPS]
    longer = comparison["cost"]
    rows = [(name, *(tell(row) for row in loops)) for name, tell in _OF_A_ROW.items()]
    for name, tell in _OF_A_VEHICLE.items():
        of_each = (row["vehicle"] for row in loops)
        rows.append((name, *("-" if each is None else tell(each) for each in of_each)))
    return "\n".join(
        [
            comparison_verdict(comparison),
            "",
            f"Where both reach the goal ({longer['seeds']} seeds), the drive takes "
            f"{_interval(longer['longer_s'])} s longer with the vehicle.",
            "",
            *markdown_table(("", "policy in the loop", "vehicle in the loop"), rows),
        ]
    )


def lag_sentence(sweep: Found) -> str:
    """The lag budget by the sum of dead time and time constant, and by the lag measured."""
    found = sweep["lag_budget"]
    goal = f"at least {found['target_success']:.0%} success"
    if found["all_hold"]:
        return f"The policy holds {goal} at every lag that was tested."
    if found["sum_ms"] is None:
        return f"The policy is below {found['target_success']:.0%} success at the least lag tested."
    measured = "" if found["measured_ms"] is None else f" (measured: {found['measured_ms']:.0f} ms)"
    return (
        f"The policy holds {goal} at every tested point whose dead time and time constant sum up "
        f"to {found['sum_ms']:g} ms or less{measured}."
    )


def render_sweep(sweep: Found) -> str:
    """The sentence and the table: success, measured lag, stops of the driver."""
    points = {(row["constant_ms"], row["dead_ms"]): row for row in sweep["rows"].values()}
    constants, deads = (sorted({point[way] for point in points}) for way in (0, 1))

    def cell(row: Found | None) -> str:
        if row is None:
            return "-"
        star = "*" if row["stops"] else ""
        return f"{row['success']['value']:.0%}{star} ({_number(row['lag_ms'], 0)})"

    rows = [[constant, *(cell(points.get((constant, d))) for d in deads)] for constant in constants]
    return "\n".join(
        [
            f"{lag_sentence(sweep)}\n",
            f"Success of {sweep['runs']} episodes, and in brackets the lag of the speed that the "
            "drives showed, ms; a star where the driver stopped the vehicle, which did not follow:",
            "",
            *markdown_table(("time constant \\ dead time, ms", *map(str, deads)), rows),
        ]
    )


def share(estimate: Mapping[str, float]) -> str:
    """As in "95 % (83 to 99)"."""
    return f"{estimate['value']:.0%} ({estimate['low']:.0%} to {estimate['high']:.0%})"


def _interval(estimate: Mapping[str, float]) -> str:
    value, low, high = (f"{estimate[name]:.2f}" for name in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _numbers(found: Mapping[str, float | None] | None, digits: int) -> str:
    return " / ".join(_number(value, digits) for value in found.values()) if found else "-"


def write_figures(out: Path, swept: Found) -> dict[str, str]:
    """Write a PNG beside ``out``, with a panel for each axis of a report's part; its name."""
    name = f"{out.stem}_success.png"
    write_png(out.with_name(name), _draw_axes(swept))
    return {"success": name}


def write_png(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())


def _draw_axes(swept: Found) -> Figure:
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
        panel.axhline(target, color="0.4", lw=0.8, linestyle="--", label=f"{target:.0%}")
        panel.set_ylim(-0.03, 1.03)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.supylabel("success")
    drives = f"{swept['scenario']}, {swept['condition']}, {swept['runs']} episodes a point"
    handles, title = (
        figure.axes[0].get_legend_handles_labels(),
        f"{drives}; bands: Wilson's 95 % interval",
    )
    figure.legend(*handles, loc="outside upper center", ncols=4, title=title, frameon=False)
    return figure
