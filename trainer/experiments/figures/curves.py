"""Learning curves: a mean line and a band of one standard deviation over the seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from trainer.experiments.figures.style import (
    colour,
    label,
    letter,
    new_figure,
    note_missing,
    other_colour,
)
from trainer.experiments.gathered import Gathered, Numbers, Outcome
from trainer.experiments.plan import FULL_PATH_M, NORMAL, SCENARIO_TITLES
from trainer.experiments.statistics import WINDOW, smoothed

METRICS = {"episode_return": "training reward", "distance_m": "surviving distance, m"}
"""What learning curves show: episodes in which the human may take over."""
ALONE = "validation_distance_m"
TITLES = {**METRICS, ALONE: "surviving distance of the policy alone, m"}

STYLES = ("-", "--", ":", "-.")
"""Of an algorithm's settings, the normal one first."""


class Line(NamedTuple):
    """One curve of a panel."""

    algorithm: str
    setting: str = NORMAL

    @property
    def label(self) -> str:
        """As in the legend."""
        return label(self.algorithm) + ("" if self.setting == NORMAL else f", {self.setting}")


def draw_curves(gathered: Gathered, lines: Sequence[Line], by_metric: bool = False) -> Figure:
    """Six panels: the paper's reward and surviving distance, and the policy alone, twice.

    Args:
        gathered: the units.
        lines: the curves of each panel.
        by_metric: a row a metric (figs. 11 to 13) instead of a row a scenario.
    """
    figure = new_figure(10.0, 9.6) if by_metric else new_figure(16.0, 6.6)
    shape = (len(TITLES), len(SCENARIO_TITLES))
    # Scenarios differ in their number of episodes.
    if by_metric:
        panels = figure.subplots(*shape, sharex="col")
    else:
        panels = figure.subplots(*shape[::-1], sharex="row")
    for row, column in np.ndindex(panels.shape):
        metric_at, scenario_at = (row, column) if by_metric else (column, row)
        metric, scenario = list(TITLES)[metric_at], list(SCENARIO_TITLES)[scenario_at]
        title = f"{TITLES[metric]}, {SCENARIO_TITLES[scenario]}"
        letter(panels[row, column], row * panels.shape[1] + column, title)
        _draw_panel(panels[row, column], gathered, lines, scenario, metric)
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
    beside = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)}
    for panel in panels[-1] if by_metric else panels[:, -1]:
        panel.legend(fontsize=8, **(below if by_metric else beside))
    figure.supxlabel(
        f"training episode (in training: mean of {WINDOW}; alone: as validated; "
        "band: standard deviation of seeds)",
        fontsize=9,
    )
    return figure


def _draw_panel(
    panel: Any, gathered: Gathered, lines: Sequence[Line], scenario: str, metric: str
) -> None:
    for line in lines:
        outcomes = gathered.of(scenario, line.algorithm, line.setting)
        named = f"{line.label} ({len(outcomes)} of {gathered.seeds} seeds)"
        shade, style = _look(line, lines)
        if not outcomes:
            panel.plot([], [], style, color=shade, alpha=0.4, label=named)
            continue
        episodes, curves = _curves(outcomes, metric)
        mean, deviation = curves.mean(axis=0), curves.std(axis=0)
        panel.plot(episodes, mean, style, color=shade, label=named)
        panel.fill_between(
            episodes, mean - deviation, mean + deviation, color=shade, alpha=0.18, lw=0
        )
    if metric != "episode_return":
        panel.axhline(FULL_PATH_M[scenario], color="0.6", lw=0.8, ls=":")
    if not panel.has_data():
        note_missing(panel)
    panel.grid(alpha=0.3)


def _curves(outcomes: Sequence[Outcome], metric: str) -> tuple[Numbers, Numbers]:
    """Episodes counted from 1, and a curve a seed there: smoothed, or just where validated."""
    if metric != ALONE:
        curves = smoothed([outcome.curve(metric) for outcome in outcomes])
        return np.arange(1.0, curves.shape[1] + 1.0), curves
    measured = [outcome.measured(metric) for outcome in outcomes]
    shortest = min(len(episodes) for episodes, _ in measured)
    return measured[0][0][:shortest], np.stack([values[:shortest] for _, values in measured])


def _look(line: Line, lines: Sequence[Line]) -> tuple[str, str]:
    """Colour and style: settings differ by style, or by colour where all are of one algorithm."""
    place = lines.index(line)
    settings = [other.setting for other in lines if other.algorithm == line.algorithm]
    if len(settings) == len(lines) and place > 0:
        return other_colour(place), STYLES[0]
    style = STYLES[settings.index(line.setting)] if NORMAL in settings else STYLES[1]
    return colour(line.algorithm, place), style
