"""The lag table as a picture: success at every point, and the line where it leaves the target."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from edge_runtime.files import write_atomic
from hil_tests.campaign.figures import write_figures as write_lines


def write_figures(out: Path, sweep: Mapping[str, Any]) -> dict[str, str]:
    """Write the pictures beside ``out``; their names by figure."""
    path = out.with_name(f"{out.stem}_table.png")
    write_atomic(path, _draw_table(sweep))
    return {"table": path.name, **(write_lines(out, sweep, {}) if sweep["axes"] else {})}


def _draw_table(sweep: Mapping[str, Any]) -> bytes:
    rows = sweep["rows"].values()
    dead = sorted({row["dead_ms"] for row in rows})
    constant = sorted({row["constant_ms"] for row in rows})
    success = np.full((len(constant), len(dead)), np.nan)
    for row in rows:
        place = constant.index(row["constant_ms"]), dead.index(row["dead_ms"])
        success[place] = row["success"]["value"]
    target = sweep["lag_budget"]["target_success"]
    figure = Figure(figsize=(0.8 * len(dead) + 2.5, 0.55 * len(constant) + 2.0))
    figure.set_layout_engine("constrained")
    panel = figure.subplots()
    image = panel.imshow(success, origin="lower", aspect="auto", vmin=0.5, vmax=1, cmap="RdYlGn")
    for y, line in enumerate(success):
        for x, value in enumerate(line):
            if np.isnan(value):
                continue  # not asked for
            weight = "bold" if value >= target else "normal"
            panel.text(
                x, y, f"{value:.0%}", ha="center", va="center", fontsize=8, weight=weight,
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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
