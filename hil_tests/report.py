"""A campaign's report for people: Markdown beside the JSON, with its tables and pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.util import UserError
from hil_tests.sweep import LOOPS, VEHICLE

Found = Mapping[str, Any]
"""A part of a report's JSON."""
MARKDOWN = ".md"
FIGURES = {
    "success": ("success", "success", "Wilson's 95 % interval"),
    "distance": ("surviving_distance_m", "surviving distance, m", "Student's 95 % interval"),
}
"""Figure -> what of a row it shows, its label, and what the band is."""
COLUMNS = 3


def check_report(out: Path) -> None:
    """Raise UserError now, before the long work, if `write_report` would fail after it."""
    if out.suffix == MARKDOWN:
        raise UserError(f"--out {out} is for the JSON; the Markdown is written beside it")
    check_writable(out)
    check_writable(out.with_suffix(MARKDOWN))


def write_report(out: Path, report: Found, lines: Sequence[str]) -> None:
    """Write ``out`` and, with its ``lines``, the Markdown beside it."""
    write_json_out(out, report)
    text = "\n".join(lines).rstrip() + "\n"
    write_atomic(out.with_suffix(MARKDOWN), text.encode())


def render_faults(report: Found) -> str:
    """A row for each fault; reaction and recovery as min / median / max over its tries."""
    head = ("fault", "expected", "tries", "reaction, ms", "limit", "recovery, ms", "limit",
            "verdict")  # fmt: skip
    rows = []
    for row in report["rows"]:
        tries = str(row["tries"]) + (f" (+{row['disturbed']} again)" if row["disturbed"] else "")
        times = (
            _spread(row["reaction_ms"]), _number(row["reaction_limit_ms"], 0),
            _spread(row["recovery_ms"]), _number(row["recovery_limit_ms"], 0),
        )  # fmt: skip
        rows.append((row["done"], row["expected"], tries, *times, fault_verdict(row)))
    end = (
        f"{report['crashes']} crashes and {report['unsafe_commands']} unsafe commands "
        "over the whole campaign."
    )
    return "\n".join([*table(head, rows), "", end])


def fault_verdict(row: Found) -> str:
    """``met``, or what was not."""
    faults = [
        f"{row[f'{name}_late']} {name} late"
        for name in ("reactions", "recoveries")
        if row[f"{name}_late"]
    ]
    faults += [f"{len(row[name])} {name}" for name in ("unsafe", "crashes", "wrong") if row[name]]
    counted = sum(row["rejected"].values())
    met = f"met, {counted:,} rejected and counted" if counted else "met"
    return "MISSED: " + ", ".join(faults) if faults else met


def render_latency(latency: Found, figures: Mapping[str, str], others: Mapping[str, Found]) -> str:
    """Sentences of the budgets, pictures, and a table for each axis."""
    sentences = [part["budget"]["sentence"] for part in (latency, *others.values())]
    speed = f"{latency['faster_than_real_time']:.1f} times real time in each worker"
    lines = [
        *(f"{sentence}\n" for sentence in sentences),
        "A limit is the largest tested value up to which, at every tested value, the share of "
        f"successes over {latency['runs']} episodes (the same seeds in every row) is at the "
        f"target; nothing is interpolated. Clock: {latency['clock']}, {speed}, the start of each "
        "simulator included.",
        "",
        *(f"![{name}]({path})\n" for name, path in figures.items()),
    ]
    for axis in latency["axes"]:
        title = f"### {axis['title'][0].upper()}{axis['title'][1:]}"
        lines += [title, "", *_latency_table(axis, latency["rows"]), ""]
    return "\n".join(lines)


def _latency_table(axis: Found, rows: Found) -> list[str]:
    head = ("value", "success", "95 %", "surviving distance, m", "collisions",
            "safe stops an episode", "ticks without a new command",
            "latency p50 / p99, ms")  # fmt: skip
    cells = []
    for value, spec in zip(axis["values"], axis["specs"], strict=True):
        row = rows[spec]
        success = row["success"]
        cells.append(
            (
                f"{value:g} {axis['unit']}",
                f"{success['value']:.0%}",
                f"{success['low']:.0%} to {success['high']:.0%}",
                _interval(row["surviving_distance_m"], 2),
                f"{row['collision_rate']:.0%}",
                f"{row['safe_stops_per_episode']:.2f}",
                f"{row['ticks_without_new_command']:.0%}",
                _pair(row["latency_ms"], 0, ("p50", "p99")),
            )
        )
    return table(head, cells)


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
    rows = [(name, *(tell(row) for row in loops)) for name, tell in _OF_A_LOOP.items()]
    for name, tell in _OF_A_VEHICLE.items():
        of_each = (row["vehicle"] for row in loops)
        rows.append((name, *("-" if each is None else tell(each) for each in of_each)))
    return "\n".join(
        [
            comparison_verdict(comparison),
            "",
            f"Where both reach the goal ({longer['seeds']} seeds), the drive takes "
            f"{_interval(longer['longer_s'], 2)} s longer with the vehicle.",
            "",
            *table(("", "policy in the loop", "vehicle in the loop"), rows),
        ]
    )


_OF_A_LOOP: dict[str, Callable[[Found], str]] = {
    "episodes": lambda row: str(row["episodes"]),
    "success (95 %)": lambda row: share(row["success"]),
    "collisions": lambda row: f"{row['collision_rate']:.0%}",
    "surviving distance, m (95 %)": lambda row: _interval(row["surviving_distance_m"], 2),
    "time, s": lambda row: f"{row['episode_time_s']:.2f}",
    "latency p50 / p99, ms": lambda row: _pair(row["latency_ms"], 1, ("p50", "p99")),
    "safe stops an episode": lambda row: f"{row['safe_stops_per_episode']:.2f}",
}
_OF_A_VEHICLE: dict[str, Callable[[Found], str]] = {
    "speed error rmse / max, m/s of the vehicle": lambda vehicle: _pair(
        vehicle["speed_error_mps"], 3, ("rmse", "max")
    ),
    "action error rmse / max": lambda vehicle: ", ".join(
        f"{name} {_pair(error, 2, ('rmse', 'max'))}"
        for name, error in vehicle["action_error"].items()
    ),
    "actuator lag, ms": lambda vehicle: ", ".join(
        f"{name} {_number(lag, 0)}" for name, lag in vehicle["lag_ms"].items()
    ),
    "feedback age p50 / p99, ms": lambda vehicle: _pair(
        vehicle["feedback_age_ms"], 1, ("p50", "p99")
    ),
    "metres of the vehicle for one of the scenario": lambda vehicle: _number(vehicle["scale"], 3),
}


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


def render_sweep(sweep: Found, figures: Mapping[str, str]) -> str:
    """The sentences, the pictures, and the table: success, measured lag, stops of the driver."""
    points = {(row["constant_ms"], row["dead_ms"]): row for row in sweep["rows"].values()}
    constants, deads = (sorted({point[way] for point in points}) for way in (0, 1))
    sentences = [lag_sentence(sweep)]
    if sweep["budget"]:
        sentences.append(sweep["budget"]["sentence"])
    rows = [
        (str(constant), *(_point(points.get((constant, dead))) for dead in deads))
        for constant in constants
    ]
    return "\n".join(
        [
            *(f"{sentence}\n" for sentence in sentences),
            *(f"![{name}]({path})\n" for name, path in figures.items()),
            f"Success of {sweep['runs']} episodes, and in brackets the lag of the speed that the "
            "drives showed, ms; a star where the driver stopped the vehicle, which did not follow:",
            "",
            *table(("time constant \\ dead time, ms", *map(str, deads)), rows),
        ]
    )


def _point(row: Found | None) -> str:
    if row is None:
        return "-"
    star = "*" if row["stops"] else ""
    return f"{row['success']['value']:.0%}{star} ({_number(row['lag_ms'], 0)})"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:]]


def share(estimate: Mapping[str, float]) -> str:
    """As in "95 % (83 to 99)"."""
    return f"{estimate['value']:.0%} ({estimate['low']:.0%} to {estimate['high']:.0%})"


def _interval(estimate: Mapping[str, float], digits: int) -> str:
    value, low, high = (f"{estimate[name]:.{digits}f}" for name in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _pair(found: Mapping[str, float | None], digits: int, names: Sequence[str]) -> str:
    return " / ".join(_number(found[name], digits) for name in names)


def _spread(spread: Mapping[str, float] | None) -> str:
    return "-" if spread is None else _pair(spread, 0, ("min", "median", "max"))


def write_figures(
    out: Path, swept: Found, others: Mapping[str, Found] | None = None
) -> dict[str, str]:
    """Write a PNG of success and one of surviving distance beside ``out``: a panel for each axis.

    Args:
        out: the report's path; the pictures' names begin with its stem.
        swept: the report's part of this policy.
        others: parts of other reports by the name to show them under.

    Returns:
        The files' names by figure.
    """
    parts = {Path(swept["policy"]).stem: swept, **(others or {})}
    names = {}
    for figure_name, (field, label, band) in FIGURES.items():
        path = out.with_name(f"{out.stem}_{figure_name}.png")
        write_png(path, _draw_axes(parts, swept, field, label, band))
        names[figure_name] = path.name
    return names


def write_lag_figures(out: Path, sweep: Found) -> dict[str, str]:
    """The table of lags as a picture, and the lines through it where they are whole."""
    path = out.with_name(f"{out.stem}_table.png")
    write_png(path, _draw_lags(sweep))
    return {"table": path.name, **(write_figures(out, sweep) if sweep["axes"] else {})}


def write_png(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())


def _draw_axes(
    parts: Mapping[str, Found], swept: Found, field: str, label: str, band: str
) -> Figure:
    axes = swept["axes"]
    rows, columns = math.ceil(len(axes) / COLUMNS), min(COLUMNS, len(axes))
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten().tolist()
    for panel, axis in zip(panels, axes, strict=False):
        for number, (name, part) in enumerate(parts.items()):
            _draw_curve(panel, axis, part["rows"], field, name, f"C{number}")
        panel.set_xlabel(f"{axis['title']}, {axis['unit']}", fontsize=9)
        panel.grid(alpha=0.3)
        if field == "success":
            target = swept["budget"]["target_success"]
            panel.axhline(target, color="0.4", lw=0.8, linestyle="--", label=f"{target:.0%}")
            panel.set_ylim(-0.03, 1.03)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.supylabel(label)
    title = (
        f"{swept['scenario']}, {swept['condition']}, {swept['runs']} episodes a point; "
        f"bands: {band}"
    )
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, title=title, frameon=False)
    return figure


def _draw_curve(panel: Any, axis: Found, rows: Found, field: str, name: str, colour: str) -> None:
    points = [
        (value, rows[spec][field])
        for value, spec in zip(axis["values"], axis["specs"], strict=True)
        if spec in rows
    ]
    values = [value for value, _ in points]
    panel.plot(values, [e["value"] for _, e in points], "o-", ms=3.5, color=colour, label=name)
    low, high = ([e[end] for _, e in points] for end in ("low", "high"))
    panel.fill_between(values, low, high, color=colour, alpha=0.2, linewidth=0)


def _draw_lags(sweep: Found) -> Figure:
    rows = sweep["rows"].values()
    dead = sorted({row["dead_ms"] for row in rows})
    constant = sorted({row["constant_ms"] for row in rows})
    success = np.full((len(constant), len(dead)), np.nan)
    for row in rows:
        place = constant.index(row["constant_ms"]), dead.index(row["dead_ms"])
        success[place] = row["success"]["value"]
    target = sweep["lag_budget"]["target_success"]
    size = (0.8 * len(dead) + 2.5, 0.55 * len(constant) + 2.0)
    figure = Figure(figsize=size, layout="constrained")
    panel = figure.subplots()
    image = panel.imshow(success, origin="lower", aspect="auto", vmin=0.5, vmax=1, cmap="RdYlGn")
    for (y, x), value in np.ndenumerate(success):
        if np.isnan(value):
            continue  # not asked for
        panel.text(
            x, y, f"{value:.0%}", ha="center", va="center", fontsize=8,
            weight="bold" if value >= target else "normal",
            color="white" if abs(value - 0.75) > 0.18 else "black",  # dark at both ends
        )  # fmt: skip
    panel.set_xticks(range(len(dead)), [str(value) for value in dead])
    panel.set_yticks(range(len(constant)), [str(value) for value in constant])
    panel.set_xlabel("dead time of the actuator, ms")
    panel.set_ylabel("its time constant, ms")
    panel.set_title(
        f"{sweep['scenario']}: success with a simulated Hunter in the loop, {sweep['runs']} "
        f"episodes a point\n(bold: at least {target:.0%}; white: not tested)",
        fontsize=10,
    )
    figure.colorbar(image, label="success")
    return figure
