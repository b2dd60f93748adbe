"""Figures of the studies."""

from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from edge_runtime.files import write_atomic
from trainer.environments import CONDITIONS
from trainer.experiments.plan import (
    EXPERIMENTS,
    FULL_PATH_M,
    GOOD,
    HELPED,
    NORMAL,
    ROWS,
    SCENARIOS,
    TASKS,
    Line,
    words,
)
from trainer.experiments.records import (
    ALONE,
    ARRIVED_ONLY,
    DISTANCE,
    LEARNED,
    REWARD,
    SUCCESS,
    TRAINING,
    Numbers,
    Records,
)
from trainer.training.metrics import DOTS_PER_INCH

KEPT_COLOURS = 64  # Of a figure's pixels
Draw = Callable[[Records], Figure]
COLOURS = {"phil_td3": "C3", "ia_td3": "C0", "hi_td3": "C2", "per_td3": "C7", "human_model": "C1"}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black", "C1")
"""For algorithms without a colour of their own, by their place in the figure."""
MARKERS = {NORMAL: "o", "one_frame": "D", "random": "^", "biased": "v"}
CURVES = ((REWARD, TRAINING), (DISTANCE, TRAINING), (SUCCESS, ALONE), (DISTANCE, ALONE))
TIME_S, LATERAL, LONGITUDINAL = ARRIVED_ONLY
TITLES = {
    REWARD: "reward",
    DISTANCE: "surviving distance, m",
    SUCCESS: "success",
    TIME_S: "time to the goal, s",
    LATERAL: "mean |lateral acceleration|, m/s²",
    LONGITUDINAL: "mean |longitudinal acceleration|, m/s²",
}


def _look(line: Line, place: int) -> dict[str, Any]:
    return {"color": COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)]), "label": line.name}


def draw_band(axis: Axes, x: Numbers, values: Numbers, style: str, **look: Any) -> None:
    """Draw the mean of the seeds, [seeds, points], in a band of their standard deviation."""
    mean, std = values.mean(axis=0), values.std(axis=0, ddof=min(len(values) - 1, 1))
    axis.plot(x, mean, style, lw=1.8, **look)
    axis.fill_between(x, mean - std, mean + std, color=look["color"], alpha=0.15, lw=0)


def draw_curves(name: str, records: Records) -> Figure:
    """Draw a row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row").flat
    for panel, (scenario, (metric, kind)) in zip(panels, product(SCENARIOS, CURVES), strict=True):
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        for place, line in enumerate(EXPERIMENTS[name].lines):
            curves = records.curves(scenario, line, f"{metric} {kind}")
            # The printed reward is on another scale.
            if len(curves) and (metric, line.setting) != (REWARD, "printed"):
                style = "-" if line.setting == NORMAL else "--"
                draw_band(panel, records.grid(scenario), curves, style, **_look(line, place))
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(top=1.05 * best)
        panel.grid(alpha=0.3)
    if panel.get_legend_handles_labels()[1]:
        panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_points(name: str, quantities: list[tuple[str, str]], records: Records) -> Figure:
    """Draw the lines side by side under each test condition.

    ``quantities``: for each row of panels one in the left turn, one in the congestion.
    """
    lines, names = EXPERIMENTS[name].lines, list(CONDITIONS)
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * len(quantities)), layout="constrained")
    panels = figure.subplots(len(quantities), len(SCENARIOS), squeeze=False).flat
    for panel, (scenario, quantity) in zip(
        panels, ((s, q) for row in quantities for s, q in zip(SCENARIOS, row, strict=True)),
        strict=True,
    ):  # fmt: skip
        panel.set_title(f"{words(scenario)}: {TITLES[quantity]}", fontsize=10)
        for place, line in enumerate(lines):
            found = records.of(scenario, line)
            found = found.reindex(columns=[f"{quantity} {condition}" for condition in names])
            x = np.arange(len(names)) + 0.8 * (place + 0.5) / len(lines) - 0.4
            marker = MARKERS[line.setting]
            look = {"marker": marker, "ms": 5, "ls": "none", "capsize": 2, **_look(line, place)}
            panel.errorbar(x, found.mean(), found.std(), **look)
        panel.set_xticks(range(len(names)), names)
        panel.grid(alpha=0.3)
    figure.legend(*panel.get_legend_handles_labels(), ncols=6, loc="outside upper center")
    figure.supxlabel("mean and standard deviation of the seeds", fontsize=8)
    return figure


def draw_guidance(records: Records) -> Figure:
    """Draw a panel a task, a dot a seed: the human's seconds until a row learned, its success."""
    figure = Figure(figsize=(3.3 * len(TASKS) + 1.5, 7.0), layout="constrained")
    panels = figure.subplots(2, len(TASKS), sharey=True)
    heights = dict(zip(ROWS, -np.arange(len(ROWS)), strict=True))

    def dots(panel: Axes, row: str, values: Any, middle: float) -> None:
        height, colour = heights[row], "C3" if row == "phil_td3" else "C0"
        places = height + np.linspace(0.2, -0.2, len(values))
        panel.plot(values, places, "o", ms=4, alpha=0.55, mew=0, color=colour)
        panel.plot([middle] * 2, [height - 0.35, height + 0.35], lw=2, color=colour)

    for (above, below), task in zip(panels.T, TASKS, strict=True):
        found = {row: records.of(task, Line(row, GOOD)) for row in ROWS}
        learned = {row: found[row][f"human_s_to_{LEARNED:.0%}"] for row in HELPED}
        finite = [s for row in HELPED for s in learned[row] if s < np.inf]
        most = max(finite, default=1.0)
        never = 1.15 * most
        for row in ROWS:
            success = 100.0 * found[row]["success nominal"]
            dots(below, row, success, success.mean())
            if row in HELPED:
                cut = learned[row].clip(upper=never)
                dots(above, row, cut, cut.quantile(interpolation="higher"))
        above.axvline(1.08 * most, color="0.6", lw=0.8, ls=":")
        above.text(never, 0.8, "never", ha="center", fontsize=8)
        above.set(title=words(task), xlim=(0.0, 1.25 * most))
        above.set_xlabel(f"seconds of the human until {LEARNED:.0%} alone", fontsize=9)
        below.set(xlim=(-4.0, 104.0))
        below.set_xlabel("success, nominal tests, %", fontsize=9)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
        panel.set_yticks(list(heights.values()), [Line(row).name for row in ROWS], fontsize=8)
        panel.set_ylim(heights[ROWS[-1]] - 0.6, 1.6)
    return figure


FIGURES: Mapping[str, Mapping[str, Draw]] = {
    "paper": {
        **{name: partial(draw_curves, name)
           for name in ("fig7", "fig8", "fig11", "fig12", "fig13", "ablation", "printed")},
        "fig9": partial(draw_points, "fig9", [(SUCCESS, SUCCESS), (DISTANCE, DISTANCE)]),
        "fig10": partial(draw_points, "fig10", [(TIME_S, LATERAL)]),
        "fig14": partial(draw_points, "fig14", [(DISTANCE, DISTANCE)]),
        "fig15": partial(draw_points, "fig15", [(LONGITUDINAL, LATERAL)]),
    },
    "guidance": {"guidance": draw_guidance},
}  # fmt: skip
"""Study -> name of a figure's file, and of the experiment -> how it is drawn."""


def write(figure: Figure, path: Path) -> None:
    """Write a PNG of few colours, which takes a third of the bytes."""
    drawn, buffer = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS_PER_INCH)
    picture = Image.open(drawn).convert("RGB").quantize(KEPT_COLOURS, dither=Image.Dither.NONE)
    picture.save(buffer, "png", optimize=True)
    write_atomic(path, buffer.getvalue())
