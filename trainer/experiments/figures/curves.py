"""Learning curves: a mean line and a band of one standard deviation over the seeds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

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
from trainer.experiments.plan import FULL_PATH_M, NORMAL, PRINTED_REWARD, SCENARIO_TITLES
from trainer.experiments.progress import ALONE, TITLES, progress
from trainer.experiments.statistics import WINDOW

STYLES = ("-", "--", ":", "-.")
"""Of an algorithm's settings, the normal one first."""
WIDEST, WIDTH_STEP, THINNEST = 3.0, 0.6, 1.2
"""Of the lines, in points."""


class Line(NamedTuple):
    """One curve of a panel."""

    algorithm: str
    setting: str = NORMAL
    name: str = ""
    """What it stands for here, where that is not the algorithm's own name."""

    @property
    def label(self) -> str:
        """As in the legend."""
        setting = "" if self.setting == NORMAL else f", {self.setting.replace('_', ' ')}"
        return (self.name or label(self.algorithm)) + setting


def draw_curves(gathered: Gathered, lines: Sequence[Line], by_metric: bool = False) -> Figure:
    """Six panels: the paper's reward and surviving distance, and the policy alone, by scenario.

    Args:
        gathered: the units.
        lines: the curves of each panel.
        by_metric: a row a metric (figs. 11 to 13) instead of a row a scenario.
    """
    if by_metric:
        places = [[(scenario, metric) for scenario in SCENARIO_TITLES] for metric in TITLES]
        heights = [0.6 if metric == "distance_m" else 1.0 for metric in TITLES]
        figure = new_figure(10.0, 8.6)
        legend = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
    else:
        places = [[(scenario, metric) for metric in TITLES] for scenario in SCENARIO_TITLES]
        heights = [1.0] * len(SCENARIO_TITLES)
        figure = new_figure(16.0, 6.6)
        legend = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)}
    # Panels of one scenario share their episodes; the other one's are more or fewer.
    panels: Any = figure.subplots(
        len(places), len(places[0]), sharex="col" if by_metric else "row", height_ratios=heights
    )
    for number, (scenario, metric) in enumerate(chain.from_iterable(places)):
        panel = panels.flat[number]
        letter(panel, number, f"{TITLES[metric]}, {SCENARIO_TITLES[scenario]}")
        _draw_panel(panel, gathered, lines, scenario, metric)
    for panel in panels[-1] if by_metric else panels[:, -1]:
        panel.legend(fontsize=8, **legend)
    figure.supxlabel(
        f"x: training episode. In training: the human may take over; mean of the last {WINDOW} "
        "episodes, none counted beyond the goal.\n"
        "Without help: the policy alone, where it was validated. "
        f"Band: standard deviation over the seeds.{_left_out(lines)}",
        fontsize=9,
    )
    return figure


def _left_out(lines: Sequence[Line]) -> str:
    unlike = any(line.setting == PRINTED_REWARD for line in lines)
    return " The printed reward, on another scale, is not drawn." if unlike else ""


def _draw_panel(
    panel: Any, gathered: Gathered, lines: Sequence[Line], scenario: str, metric: str
) -> None:
    for place, line in enumerate(lines):
        if metric == "episode_return" and line.setting == PRINTED_REWARD:
            continue
        outcomes = gathered.of(scenario, line.algorithm, line.setting)
        named = f"{line.label} ({len(outcomes)} of {gathered.seeds} seeds)"
        shade, style = _look(line, lines)
        found = progress(outcomes, metric)
        if found is None:
            panel.plot([], [], style, color=shade, alpha=0.4, label=named)
            continue
        # A mean of fewer episodes than the caption says would be another curve.
        episodes, curves = found.episodes[found.whole], found.curves[:, found.whole]
        mean, deviation = curves.mean(axis=0), curves.std(axis=0)
        # The first ones wider: where all arrive, each is seen below those drawn over it.
        width = max(WIDEST - WIDTH_STEP * place, THINNEST)
        panel.plot(episodes, mean, style, color=shade, lw=width, label=named)
        panel.fill_between(
            episodes, mean - deviation, mean + deviation, color=shade, alpha=0.18, lw=0
        )
    if metric != "episode_return":
        best = 1.0 if metric == ALONE else FULL_PATH_M[scenario]
        panel.axhline(best, color="0.6", lw=0.8, ls=":")
        panel.set_ylim(0.0, 1.05 * best)
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
