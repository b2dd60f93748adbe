"""``python -m trainer plot``: learning curves as pictures."""

import argparse
import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bridge.outcomes import GOAL
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.training.config import CURVE_FILE
from trainer.training.metrics import read_metrics

DOTS_PER_INCH = 110
WINDOW = 20  # Episodes of the moving average
PANELS = {
    "episode_return": "return (without shaping)",
    "distance_m": "surviving distance, m",
    "success": "success",
    "human_share": "share of steps driven by the human",
}
Values = NDArray[np.float64]


def run(arguments: argparse.Namespace) -> int:
    if arguments.out is None and len(arguments.run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    print(write_learning_curve(*map(Path, arguments.run_dirs), out=arguments.out))
    return 0


def write_learning_curve(*run_dirs: Path, out: str | None = None) -> Path:
    """Draw return, surviving distance, success and human share over the episodes as a PNG.

    Each of several runs is a thin line; the thick one is their mean, up to the end of the shortest.
    ``out`` is by default in the first run's directory.

    Raises UserError: a run has no metrics yet, or the file cannot be written.
    """
    path = run_dirs[0] / CURVE_FILE if out is None else Path(out)
    check_writable(path)
    runs = [_columns(run_dir) for run_dir in run_dirs]
    shortest = min(len(run["episode"]) for run in runs)
    episodes = runs[0]["episode"][:shortest]
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(2, 2, sharex=True).flat, strict=True))
    for name, panel in panels.items():
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
        panel.set_title(PANELS[name])
        panel.grid(alpha=0.3)
    # Mean success of the policy alone, where all runs were validated.
    validated = np.array([run["validation"][:shortest] for run in runs])
    tested = ~np.isnan(validated).any(axis=0)
    means = validated[:, tested].mean(axis=0)
    success = panels["success"]
    success.plot(episodes[tested], means, "o-", color="C1", label="policy alone, validation")
    success.legend()
    for name in ("success", "human_share"):
        panels[name].set_xlabel("episode")
    write_figure(figure, path)
    return path


def write_figure(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH)
    write_atomic(path, buffer.getvalue())


def moving_average(values: Values, window: int) -> Values:
    """Return the means of the last ``window`` values (fewer at the start), same length."""
    sums = np.convolve(values, np.ones(window))[: len(values)]
    return sums / np.minimum(np.arange(1, len(values) + 1), window)


def _columns(run_dir: Path) -> dict[str, Values]:
    rows = read_metrics(run_dir)
    if not rows:
        raise UserError(f"{run_dir} holds no metrics to draw")

    def column(name: str) -> Values:
        # Kept results have an empty field where there was no number.
        return np.array([row.get(name) or "nan" for row in rows], dtype=float)

    return {
        "episode": column("episode") + 1,
        "episode_return": column("episode_return"),
        "distance_m": column("distance_m"),
        "success": np.array([row["outcome"] == GOAL for row in rows], dtype=float),
        "human_share": column("human_steps") / column("steps"),
        "validation": column("validation_success"),
    }
