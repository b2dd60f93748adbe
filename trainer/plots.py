"""Draw the learning curve of a run, or of several that differ in their seeds."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bridge.report import GOAL
from edge_runtime.cli import examples
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.options import check_suffix, existing_directory
from trainer.training.metrics import read_metrics

EXAMPLE = examples(
    "python -m trainer plot runs/phil_1",
    "python -m trainer plot runs/phil_1 runs/phil_2 runs/phil_3 --out curves.png",
)
CURVE_FILE = "learning_curve.png"
WINDOW = 20
"""Episodes of the moving average."""
Values = NDArray[np.float64]
PANELS = (
    ("episode_return", "return (without shaping)"),
    ("distance_m", "surviving distance, m"),
    ("success", "success"),
    ("human_share", "share of steps driven by the human"),
)
"""Column -> title."""
SUCCESS = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "run_dirs",
        metavar="RUN_DIR",
        nargs="+",
        help="directory of a training run; several are drawn thinly, and their mean",
    )
    text = f"the picture (default: RUN_DIR/{CURVE_FILE})"
    parser.add_argument("--out", metavar="F.png", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Draw; returns the exit status."""
    run_dirs = [existing_directory(path, "run directory") for path in arguments.run_dirs]
    if arguments.out is None and len(run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    if arguments.out is not None:
        check_suffix(arguments.out, "a picture is a .png", ".png")
    out = run_dirs[0] / CURVE_FILE if arguments.out is None else Path(arguments.out)
    check_writable(out)
    write_learning_curves(run_dirs, out)
    print(out)
    return 0


def write_learning_curve(run_dir: Path) -> Path:
    """Draw return, surviving distance, success and human share over the episodes as a PNG.

    Raises:
        UserError: the run has no metrics yet.
    """
    path = run_dir / CURVE_FILE
    write_learning_curves([run_dir], path)
    return path


def write_learning_curves(run_dirs: Sequence[Path], path: Path) -> None:
    """The same for several runs: each as a thin line, and their mean up to the shortest's end.

    Raises:
        UserError: one of them has no metrics yet.
    """
    runs = [_columns(run_dir) for run_dir in run_dirs]
    shortest = min(len(run["episode"]) for run in runs)
    episodes = runs[0]["episode"][:shortest]
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).flat
    for panel, (name, title) in zip(panels, PANELS, strict=True):
        curves = [moving_average(run[name], WINDOW) for run in runs]
        label = f"mean of {WINDOW}"
        if len(runs) == 1:
            panel.plot(episodes, runs[0][name], ".", markersize=3, color="0.75")
        else:
            label = f"{len(runs)} runs, {label}"
            for run, curve in zip(runs, curves, strict=True):
                panel.plot(run["episode"], curve, color="C0", alpha=0.25, linewidth=1)
        mean = np.mean([curve[:shortest] for curve in curves], axis=0)
        panel.plot(episodes, mean, color="C0", label=label)
        panel.set_title(title)
        panel.grid(alpha=0.3)
    # Success of the policy alone where all runs were validated, and its mean.
    validated = np.array([run["validation"][:shortest] for run in runs])
    tested = ~np.isnan(validated).any(axis=0)
    means = validated[:, tested].mean(axis=0)
    panels = figure.axes
    success = panels[SUCCESS]
    success.plot(episodes[tested], means, "o-", color="C1", label="policy alone, validation")
    success.legend()
    for panel in panels[SUCCESS:]:
        panel.set_xlabel("episode")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())


def moving_average(values: Values, window: int) -> Values:
    """The mean of the last ``window`` values (fewer at the start), same length."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def _columns(run_dir: Path) -> dict[str, Values]:
    rows = read_metrics(run_dir)
    if not rows:
        raise UserError(f"{run_dir} holds no metrics to draw")

    def column(name: str) -> Values:
        # Kept results have nothing where there was no number.
        return np.array([row.get(name) or "nan" for row in rows], dtype=float)

    return {
        "episode": column("episode") + 1,
        "episode_return": column("episode_return"),
        "distance_m": column("distance_m"),
        "success": np.array([row["outcome"] == GOAL for row in rows], dtype=float),
        "human_share": column("human_steps") / column("steps"),
        "validation": column("validation_success"),
    }
