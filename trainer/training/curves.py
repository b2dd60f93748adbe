"""``python -m trainer plot``: learning curves of runs, a line and a band for each setting."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bridge.outcomes import mean_estimate
from bridge.report import write_figure
from edge_runtime.util import UserError, read_json
from trainer.training.config import CONFIG_FILE, CURVE_FILE, EXTENT, settings_in
from trainer.training.metrics import METRICS_FILE, metrics_table

WINDOW = 20  # Episodes of the moving average
NOT_COMPARED = {"seed", "device", "threads", "checkpoint_every", *EXTENT}  # Settings
POINTS = 100  # At which the runs of an algorithm are averaged
AXES = {"steps": "environment steps", "human_s": "seconds driven by the human"}
"""Columns that curves are drawn over, the words of ``--x``: ``total_steps`` and so on."""
SUCCESS, RETURN = "validation_success", "validation_reward"
PANELS = {
    "episode_return": "return in training (without shaping)",
    "distance_m": "surviving distance in training, m",
    SUCCESS: "success of the policy alone, in validation",
    RETURN: "return of the policy alone, in validation",
    "human_share": "share of steps driven by the human",
}


def run(arguments: argparse.Namespace) -> int:
    if arguments.out is None and len(arguments.run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    dirs = list(map(Path, arguments.run_dirs))
    print(write_learning_curve(*dirs, out=arguments.out, x=arguments.x))
    return 0


def write_learning_curve(*dirs: Path, out: str | None = None, x: str = "steps") -> Path:
    """Draw return, surviving distance, validation and the human's share as a PNG.

    Runs that differ in the seed alone become one line, their mean with its 95 % interval, up to the
    end of the shortest. A directory is a run, or holds runs. If success is unknown, the
    validation's return is drawn instead. ``out`` defaults to a file in the first directory.
    UserError: a run has no metrics yet.
    """
    run_dirs = [run_dir for directory in dirs for run_dir in _runs_in(directory)]
    groups: dict[str, list[pd.DataFrame]] = {}
    for run_dir, label in zip(run_dirs, _labels(run_dirs), strict=True):
        groups.setdefault(label, []).append(_curves(run_dir))
    runs = [run for group in groups.values() for run in group]
    left_out = RETURN if any(run[SUCCESS].notna().any() for run in runs) else SUCCESS
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = (name for name in PANELS if name != left_out)
    for panel, name in zip(figure.subplots(2, 2, sharex=True).flat, panels, strict=True):
        for number, (label, group) in enumerate(groups.items()):
            _draw(panel, label, f"C{number}", [run.set_index(f"total_{x}")[name] for run in group])
        panel.set_title(PANELS[name])
        panel.set_xlabel(AXES[x])
        panel.grid(alpha=0.3)
    panel.legend()
    path = dirs[0] / CURVE_FILE if out is None else Path(out)
    write_figure(figure, path)
    return path


def _runs_in(directory: Path) -> Sequence[Path]:
    if (directory / METRICS_FILE).exists():
        return [directory]
    return sorted(path.parent for path in directory.glob(f"*/{METRICS_FILE}")) or [directory]


def _labels(run_dirs: Sequence[Path]) -> Iterator[str]:
    """Yield each run's algorithm, with the settings in which the runs of this algorithm differ."""
    configs = list(map(_settings, run_dirs))
    for config in configs:
        alike = [each for each in configs if each["algorithm"] == config["algorithm"]]
        differing = [
            f"{name}={value}" for name, value in config.items()
            if name not in NOT_COMPARED and any(each.get(name) != value for each in alike)
        ]  # fmt: skip
        yield ", ".join([config["algorithm"], *differing])


def _settings(run_dir: Path) -> dict[str, Any]:
    path = run_dir / CONFIG_FILE
    saved = settings_in(read_json(path, "run config"), str(path)) if path.exists() else {}
    return {"algorithm": run_dir.name, **saved}


def _curves(run_dir: Path) -> pd.DataFrame:
    """Return a run's metrics as numbers, an episode a row, smoothed except for validation."""
    curves = metrics_table(run_dir).drop(columns="outcome").astype(float)
    if curves.empty:
        raise UserError(f"{run_dir} holds no metrics to draw")
    # The first episode also counts the demonstrations before it.
    curves["human_share"] = (curves.human_steps / curves.steps).clip(upper=1.0)
    smooth = [name for name in PANELS if name not in (SUCCESS, RETURN)]
    curves[smooth] = curves[smooth].rolling(WINDOW, min_periods=1).mean()
    return curves


def _draw(panel: Any, label: str, color: str, runs: list[pd.Series]) -> None:
    """Draw the mean of runs, each a column over its own steps; each run where none is shared."""
    runs = [run for run in (run.dropna() for run in runs) if len(run)]
    begin = max((run.index[0] for run in runs), default=0)
    end = min((run.index[-1] for run in runs), default=0)
    if len(runs) < 2 or begin >= end:
        for number, run in enumerate(runs):
            panel.plot(run, ".-", color=color, label=label if not number else None)
        return
    at = np.linspace(begin, end, POINTS)
    values = np.array([np.interp(at, run.index, run) for run in runs])
    mean, low, high, _ = np.array([mean_estimate(column) for column in values.T]).T
    panel.plot(at, mean, color=color, label=f"{label}, {len(runs)} runs")
    panel.fill_between(at, low, high, color=color, alpha=0.2, linewidth=0)
