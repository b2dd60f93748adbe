"""Plots of the latency table: one panel for each axis, an interval's band around each curve."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from edge_runtime.files import write_atomic

FIGURES = {
    "success": ("success", "success", "Wilson's 95 % interval"),
    "distance": ("surviving_distance_m", "surviving distance, m", "Student's 95 % interval"),
}
"""Figure -> what of a row it shows, its label, and what the band is."""
COLUMNS = 3


def write_figures(
    out: Path, latency: Mapping[str, Any], others: Mapping[str, Mapping[str, Any]]
) -> dict[str, str]:
    """Write a PNG of success and one of surviving distance beside ``out``.

    Args:
        out: the report's path; the pictures' names begin with its stem.
        latency: the report's part of this policy.
        others: parts of other reports by the name to show them under.

    Returns:
        The files' names by figure.
    """
    parts = {Path(latency["policy"]).stem: latency, **others}
    names = {}
    for figure_name, (field, label, band) in FIGURES.items():
        path = out.with_name(f"{out.stem}_{figure_name}.png")
        write_atomic(path, _draw(parts, latency, field, label, band))
        names[figure_name] = path.name
    return names


def _draw(
    parts: Mapping[str, Mapping[str, Any]],
    latency: Mapping[str, Any],
    field: str,
    label: str,
    band: str,
) -> bytes:
    axes = latency["axes"]
    rows = math.ceil(len(axes) / COLUMNS)
    columns = min(COLUMNS, len(axes))
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten().tolist()
    for panel, axis in zip(panels, axes, strict=False):
        for number, (name, part) in enumerate(parts.items()):
            _curve(panel, axis, part["rows"], field, name, f"C{number}")
        panel.set_xlabel(f"{axis['title']}, {axis['unit']}", fontsize=9)
        panel.grid(alpha=0.3)
        if field == "success":
            _mark_target(panel, latency["budget"]["target_success"])
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.supylabel(label)
    title = (
        f"{latency['scenario']}, {latency['condition']}, {latency['runs']} episodes a point; "
        f"bands: {band}"
    )
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, title=title, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _curve(
    panel: Any,
    axis: Mapping[str, Any],
    rows: Mapping[str, Any],
    field: str,
    name: str,
    colour: str,
) -> None:
    points = [
        (value, rows[spec][field])
        for value, spec in zip(axis["values"], axis["specs"], strict=True)
        if spec in rows
    ]
    values = [value for value, _ in points]
    panel.plot(values, [e["value"] for _, e in points], "o-", ms=3.5, color=colour, label=name)
    low, high = ([e[end] for _, e in points] for end in ("low", "high"))
    panel.fill_between(values, low, high, color=colour, alpha=0.2, linewidth=0)


def _mark_target(panel: Any, target: float) -> None:
    panel.axhline(target, color="0.4", linewidth=0.8, linestyle="--", label=f"{target:.0%}")
    panel.set_ylim(-0.03, 1.03)
