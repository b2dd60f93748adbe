"""The paper's figures of the kept records: figures 7 to 15, the ablation, the printed settings."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from edge_runtime.files import write_atomic
from trainer.experiments.data import (
    ALONE,
    ARRIVED_ONLY,
    DISTANCE,
    LATERAL,
    LONGITUDINAL,
    PAPER_SCENES,
    REWARD,
    SCENES,
    SUCCESS,
    TIME_S,
    TRAINING,
    Line,
    Place,
    Results,
    Scene,
    words,
)
from trainer.experiments.plan import EXPERIMENTS, FULL_PATH_M, HUMAN_MODEL, NORMAL, SCENARIOS

DOTS_PER_INCH = 110
COLOURS = {"phil_td3": "C3", "ia_td3": "C0", "hi_td3": "C2", "per_td3": "C7", HUMAN_MODEL: "C1"}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black")
"""For algorithms without a colour of their own, by their place in the figure."""
CURVES = ((TRAINING, REWARD), (TRAINING, DISTANCE), (ALONE, SUCCESS), (ALONE, DISTANCE))
TITLES = {
    REWARD: "reward",
    DISTANCE: "surviving distance, m",
    SUCCESS: "success",
    TIME_S: "time to the goal, s",
    LATERAL: "mean |lateral acceleration|, m/s²",
    LONGITUDINAL: "mean |longitudinal acceleration|, m/s²",
}
HATCHES = {"one_frame": "//", "random": "//", "biased": "xx"}
SCENE_KEY = "L: left turn, C: congestion, -N: command noise, -V: variant, -D: dense"
Panel = tuple[Sequence[Place], str, str]
"""Side by side in a panel: the places, their quantity, and the kind of their curves."""


def colour(line: Line, place: int = 0) -> str:
    """An algorithm's colour, the same in every figure."""
    return COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)])


def lines_of(name: str) -> list[Line]:
    """The lines of an experiment, an algorithm's settings side by side."""
    one = EXPERIMENTS[name]
    return [Line(*each) for each in product(one.algorithms, one.settings)]


def draw_curves(results: Results, lines: Sequence[Line]) -> Figure:
    """A row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row")
    for panel, (scenario, (kind, metric)) in zip(
        panels.flat, product(SCENARIOS, CURVES), strict=True
    ):
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        for place, line in enumerate(lines):
            found = results.of(scenario, line)
            if not found or (metric == REWARD and line.setting == "printed"):
                continue  # the printed reward is on another scale
            curves, grid = np.stack([result.curve(kind, metric) for result in found]), found[0].grid
            mean, spread = curves.mean(axis=0), curves.std(axis=0)
            look = {"ls": "-" if line.setting == NORMAL else "--", "color": colour(line, place)}
            panel.plot(grid, mean, **look, lw=1.8, label=f"{line.name}, seeds: {len(found)}")
            band = mean - spread, mean + spread
            panel.fill_between(grid, *band, color=look["color"], alpha=0.15, lw=0)
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(0.0, 1.05 * best)
        panel.grid(alpha=0.3)
        if (kind, metric) == CURVES[-1] and panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_groups(
    results: Results, lines: Sequence[Line], panels: Sequence[Panel], rows: int
) -> Figure:
    """The lines side by side in each place of each panel: bars are means of the seeds; boxes, of
    what is compared of arrivals only, are of the drives of all seeds that arrive.
    """
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * rows), layout="constrained")
    axes, width = figure.subplots(rows, len(panels) // rows), 0.8 / len(lines)
    for axis, (places, quantity, kind) in zip(axes.flat, panels, strict=True):
        alone = "" if isinstance(places[0], Scene) else f", {kind}"
        axis.set_title(f"{TITLES[quantity]}{alone}", fontsize=10)
        for (group, place), (side, line) in product(enumerate(places), enumerate(lines)):
            x = group + (side - 0.5 * (len(lines) - 1)) * width
            look = {"fc": colour(line, side), "hatch": HATCHES.get(line.setting), "alpha": 0.7}
            if isinstance(place, Scene) and quantity in ARRIVED_ONLY:
                arrived = results.pooled(place, line, SUCCESS) > 0.0
                values = results.pooled(place, line, quantity)[arrived]
                if len(values):
                    axis.boxplot(
                        [values], positions=[x], widths=0.85 * width, patch_artist=True,
                        boxprops=look, flierprops={"ms": 2}, medianprops={"color": "black"},
                    )  # fmt: skip
            else:
                values = np.array([*results.numbers(place, line, quantity, kind).values()])
                if len(values):
                    axis.bar(x, values.mean(), width, yerr=values.std(), capsize=2, **look)
        axis.set_xticks(range(len(places)), [words(place) for place in places], fontsize=8)
        axis.set_xlim(-0.6, len(places) - 0.4)
        axis.grid(alpha=0.3)
        axis.set_axisbelow(True)
    handles = [
        Patch(fc=colour(line, side), hatch=HATCHES.get(line.setting), label=line.name)
        for side, line in enumerate(lines)
    ]
    figure.legend(handles=handles, fontsize=8, ncols=6, loc="outside upper center")
    figure.supxlabel(
        f"{SCENE_KEY}; bar: mean and standard deviation of the seeds; box: drives that arrive",
        fontsize=8,
    )
    return figure


def _scenes(*quantities: Sequence[str], of: Iterable[Scene] = SCENES) -> list[Panel]:
    """A panel for each scenario's scenes, with a quantity for each scenario."""
    scenes = list(of)
    return [
        ([scene for scene in scenes if scene.scenario == scenario], quantity, ALONE)
        for pair in quantities
        for scenario, quantity in zip(SCENARIOS, pair, strict=True)
    ]


ENDS: list[Panel] = [
    ([scenario], metric, kind) for scenario, (kind, metric) in product(SCENARIOS, CURVES)
]
"""Where the curves end."""
GROUPS: Mapping[str, tuple[list[Panel], int]] = {
    "fig8": (ENDS, 2),
    "fig9": (_scenes((SUCCESS, SUCCESS), (DISTANCE, DISTANCE)), 2),
    "fig10": (_scenes((TIME_S, LATERAL)), 1),
    "fig14": (_scenes((DISTANCE, DISTANCE), of=PAPER_SCENES), 1),
    "fig15": (_scenes((LONGITUDINAL, LATERAL), of=PAPER_SCENES), 1),
}
"""Figure -> its panels and their rows."""
FIGURES: Mapping[str, Callable[[Results], Figure]] = {
    **{
        name: partial(draw_curves, lines=lines_of(name))
        for name in ("fig7", "fig11", "fig12", "fig13", "ablation", "printed")
    },
    **{
        name: partial(draw_groups, lines=lines_of(name), panels=panels, rows=rows)
        for name, (panels, rows) in GROUPS.items()
    },
}
"""Name of the experiment, and of the PNG -> how it is drawn."""


def write_figure(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH)
    write_atomic(path, buffer.getvalue())
