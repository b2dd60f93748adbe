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
from trainer.experiments.gathered import Gathered
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
    """Four panels: reward and surviving distance in both scenarios.

    Args:
        gathered: the units.
        lines: the curves of each panel.
        by_metric: rewards above and distances below (figs. 11 to 13) instead of a row a scenario.
    """
    figure = new_figure(10.0 if by_metric else 12.0, 6.6)
    panels = figure.subplots(2, 2, sharex="col" if by_metric else "row")
    for row, scenario in enumerate(SCENARIO_TITLES):
        for column, metric in enumerate(METRICS):
            place = (column, row) if by_metric else (row, column)
            panel = panels[place]
            letter(
                panel, 2 * place[0] + place[1], f"{METRICS[metric]}, {SCENARIO_TITLES[scenario]}"
            )
            _draw_panel(panel, gathered, lines, scenario, metric)
        if by_metric:
            panels[1, row].legend(
                fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2
            )
        else:
            panels[row, 1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    for panel in panels[1]:
        panel.set_xlabel(
            f"training episode (mean of {WINDOW}; band: standard deviation of seeds)", fontsize=9
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
        curves = smoothed([outcome.curve(metric) for outcome in outcomes])
        mean, deviation = curves.mean(axis=0), curves.std(axis=0)
        episodes = np.arange(1, len(mean) + 1)
        panel.plot(episodes, mean, style, color=shade, label=named)
        panel.fill_between(
            episodes, mean - deviation, mean + deviation, color=shade, alpha=0.18, lw=0
        )
    if metric == "distance_m":
        panel.axhline(FULL_PATH_M[scenario], color="0.6", lw=0.8, ls=":")
    if not panel.has_data():
        note_missing(panel)
    panel.grid(alpha=0.3)


def _look(line: Line, lines: Sequence[Line]) -> tuple[str, str]:
    """Colour and style: settings differ by style, or by colour where all are of one algorithm."""
    place = lines.index(line)
    settings = [other.setting for other in lines if other.algorithm == line.algorithm]
    if len(settings) == len(lines) and place > 0:
        return other_colour(place), STYLES[0]
    style = STYLES[settings.index(line.setting)] if NORMAL in settings else STYLES[1]
    return colour(line.algorithm, place), style
