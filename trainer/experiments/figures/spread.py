"""Box plots (fig. 10), frequency distributions (fig. 15) and points beside the paper's tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from trainer.experiments.figures.style import (
    SCENE_KEY,
    colour,
    letter,
    new_figure,
    note_missing,
    short,
)
from trainer.experiments.gathered import Gathered, pairs, pooled
from trainer.experiments.plan import NORMAL, POOR, SCENES, Scene
from trainer.experiments.statistics import paired_t, stars


class Quantity(NamedTuple):
    """What a scenario's boxes and distributions show."""

    column: str
    title: str
    arrived: bool
    """Only episodes without failure."""


BOXES = {
    "left_turn": Quantity("time_s", "time of episodes without failure, s", True),
    "congestion": Quantity(
        "lateral_acceleration_mps2", "mean |lateral acceleration|, m/s², of all episodes", False
    ),
}
SMOOTHNESS = {
    "left_turn": Quantity(
        "longitudinal_acceleration_mps2", "mean |longitudinal acceleration|, m/s²", False
    ),
    "congestion": Quantity("lateral_acceleration_mps2", "mean |lateral acceleration|, m/s²", False),
}


def draw_boxes(gathered: Gathered, algorithms: Sequence[str]) -> Figure:
    """Box plots of both scenarios' secondary targets, with paired t-tests against the first.

    Below a box: of how many drives it is.
    """
    figure = new_figure(12.0, 4.8)
    for number, (panel, scenario) in enumerate(zip(figure.subplots(1, 2), BOXES, strict=True)):
        letter(panel, number, BOXES[scenario].title)
        scenes = [scene for scene in SCENES if scene.scenario == scenario]
        _box_panel(panel, gathered, algorithms, scenes, BOXES[scenario])
    figure.supxlabel(
        f"{SCENE_KEY}\n"
        "below a box: its drives, of all seeds; stars: paired t-test against PHIL-TD3; "
        "b counts drives that crash, too\n"
        "a: boxes of all drives that arrive, stars of those in which both do; "
        "b: who hardly steers looks smooth",
        fontsize=8,
    )
    return figure


def _box_panel(
    panel: Any,
    gathered: Gathered,
    algorithms: Sequence[str],
    scenes: Sequence[Scene],
    quantity: Quantity,
) -> None:
    width = 0.8 / len(algorithms)
    drawn = False
    marks = []
    for group, scene in enumerate(scenes):
        own = gathered.tested(scene, algorithms[0])
        for place, algorithm in enumerate(algorithms):
            outcomes = gathered.tested(scene, algorithm)
            values = pooled(outcomes, scene.condition, quantity.column, quantity.arrived)
            if not len(values):
                continue
            x = group + (place - 0.5 * (len(algorithms) - 1)) * width
            boxes = panel.boxplot(
                [values], positions=[x], widths=0.85 * width, patch_artist=True,
                flierprops={"markersize": 2}, medianprops={"color": "black"},
            )  # fmt: skip
            boxes["boxes"][0].set(facecolor=colour(algorithm), alpha=0.7)
            drawn = True
            panel.text(
                x, 0.01, str(len(values)), transform=panel.get_xaxis_transform(),
                ha="center", va="bottom", fontsize=7,
            )  # fmt: skip
            first, second = pairs(own, outcomes, scene.condition, quantity.column, quantity.arrived)
            if place and len(first):
                marks.append((x, stars(paired_t(first, second))))
    low, high = panel.get_ylim()
    for x, mark in marks:
        panel.text(x, high, mark, ha="center", va="bottom", fontsize=8, rotation=90)
    panel.set_ylim(low - 0.06 * (high - low), high + 0.2 * (high - low))
    panel.set_xticks(range(len(scenes)), [scene.label for scene in scenes])
    panel.set_xlim(-0.6, len(scenes) - 0.4)
    panel.grid(alpha=0.3, axis="y")
    seeds = {name: len(gathered.of(scenes[0].scenario, name)) for name in algorithms}
    named = [
        Patch(facecolor=colour(name), alpha=0.7, label=f"{short(name)} (seeds: {seeds[name]})")
        for name in algorithms
    ]
    panel.legend(handles=named, fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.08), ncols=4)
    if not drawn:
        note_missing(panel)


def draw_distributions(gathered: Gathered, algorithms: Sequence[str]) -> Figure:
    """How often each mean acceleration occurs, scene by scene (fig. 15): poor guidance as a solid
    line, good guidance as a dotted one.
    """
    figure = new_figure(13.5, 6.8)
    panels = figure.subplots(2, 3)
    for number, (panel, scene) in enumerate(zip(panels.flat, SCENES, strict=True)):
        letter(panel, number, scene.title)
        quantity = SMOOTHNESS[scene.scenario]
        _distribution_panel(panel, gathered, algorithms, scene, quantity)
        panel.set_xlabel(quantity.title, fontsize=8)
        panel.set_ylabel("share of episodes", fontsize=8)
        panel.grid(alpha=0.3)
    for panel in panels[:, -1]:  # one a scenario, whose scenes are tested together
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8, title="guidance (seeds)", title_fontsize=8, loc="center left",
                         bbox_to_anchor=(1.02, 0.5))  # fmt: skip
    figure.supxlabel("drives that crash are counted, too", fontsize=8)
    return figure


def _distribution_panel(
    panel: Any, gathered: Gathered, algorithms: Sequence[str], scene: Scene, quantity: Quantity
) -> None:
    groups = {
        (algorithm, setting): pooled(
            gathered.tested(scene, algorithm, setting), scene.condition, quantity.column
        )
        for algorithm in algorithms
        for setting in (POOR, NORMAL)
    }
    everything = np.concatenate(list(groups.values()))
    if not len(everything):
        note_missing(panel)
        return
    edges = np.linspace(everything.min(), everything.max() + 1e-9, 21)
    for (algorithm, setting), values in groups.items():
        if not len(values):
            continue
        shares = np.histogram(values, edges)[0] / len(values)
        seeds = len(gathered.tested(scene, algorithm, setting))
        panel.stairs(
            shares, edges, color=colour(algorithm), fill=False,
            ls="-" if setting == POOR else ":", lw=1.6 if setting == POOR else 1.0,
            label=f"{short(algorithm)}, {'poor' if setting == POOR else 'good'} ({seeds})",
        )  # fmt: skip


Published = Mapping[str, tuple[tuple[float, float], ...]]


def draw_table(gathered: Gathered, scenario: str, paper: Published) -> Figure:
    """A table of the paper as points: mean and standard deviation, the paper's beside ours."""
    scenes = [scene for scene in SCENES if scene.scenario == scenario]
    figure = new_figure(9.0, 4.2)
    panel = figure.subplots()
    width = 0.8 / len(paper)
    for place, (algorithm, published) in enumerate(paper.items()):
        for group, scene in enumerate(scenes):
            x = group + (place - 0.5 * (len(paper) - 1)) * width
            mean, deviation = published[group]
            panel.errorbar(x - 0.03, mean, deviation, fmt="o", color=colour(algorithm),
                           mfc="white", capsize=3, alpha=0.6)  # fmt: skip
            values = pooled(gathered.tested(scene, algorithm), scene.condition, "distance_m")
            if len(values):
                panel.errorbar(x + 0.03, values.mean(), values.std(), fmt="s",
                               color=colour(algorithm), capsize=3)  # fmt: skip
        seeds = len(gathered.of(scenario, algorithm))
        panel.plot([], [], "s", color=colour(algorithm), label=f"{short(algorithm)} ({seeds})")
    panel.plot([], [], "o", color="0.4", mfc="white", label="the paper's")
    panel.set_xticks(range(len(scenes)), [scene.title for scene in scenes])
    panel.set_ylabel("surviving distance, m (bar: standard deviation)")
    panel.grid(alpha=0.3, axis="y")
    panel.legend(fontsize=8, title="ours (policies)", title_fontsize=8, ncols=5, loc="upper center",
                 bbox_to_anchor=(0.5, -0.08))  # fmt: skip
    return figure
