"""Pictures of a run."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge_runtime.episode_report import GOAL
from edge_runtime.errors import UserError
from edge_runtime.files import write_atomic
from trainer.training.metrics import read_metrics

CURVE_FILE = "learning_curve.png"
WINDOW = 20
"""Episodes of the moving average."""


def write_learning_curve(run_dir: Path) -> Path:
    """Draw return, surviving distance, success and human share over the episodes as a PNG.

    Raises:
        UserError: the run has no metrics yet.
    """
    rows = read_metrics(run_dir)
    if not rows:
        raise UserError(f"{run_dir} holds no metrics to draw")
    column = {name: [row[name] for row in rows] for name in rows[0]}
    episodes = np.array(column["episode"], dtype=int) + 1
    steps, human_steps = (np.array(column[name], dtype=float) for name in ("steps", "human_steps"))
    success = np.array([outcome == GOAL for outcome in column["outcome"]], dtype=float)
    validation = np.array(column["validation_success"], dtype=float)
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).flat
    returns = np.array(column["episode_return"], dtype=float)
    distances_m = np.array(column["distance_m"], dtype=float)
    for panel, values, title in (
        (panels[0], returns, "return (without shaping)"),
        (panels[1], distances_m, "surviving distance, m"),
        (panels[2], success, "success"),
        (panels[3], human_steps / steps, "share of steps driven by the human"),
    ):
        panel.plot(episodes, values, ".", markersize=3, color="0.75")
        panel.plot(episodes, moving_average(values, WINDOW), color="C0", label=f"mean of {WINDOW}")
        panel.set_title(title)
        panel.grid(alpha=0.3)
    tested = ~np.isnan(validation)
    panels[2].plot(
        episodes[tested], validation[tested], "o-", color="C1", label="policy alone, validation"
    )
    panels[2].legend()
    for panel in (panels[2], panels[3]):
        panel.set_xlabel("episode")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    path = run_dir / CURVE_FILE
    write_atomic(path, buffer.getvalue())
    return path


def moving_average(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """The mean of the last ``window`` values (fewer at the start), same length."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)
