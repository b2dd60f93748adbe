"""Figures of the studies."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from io import BytesIO
from itertools import chain, product
from pathlib import Path
from statistics import mean, median_high
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from edge_runtime.files import write_atomic
from trainer.environments import CONDITIONS
from trainer.experiments import plan
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
    LATERAL,
    LEARNED,
    LONGITUDINAL,
    REWARD,
    SUCCESS,
    TIME_S,
    TRAINING,
    Numbers,
    Records,
)
from trainer.pictures import DOTS_PER_INCH

KEPT_COLOURS = 64  # Of a figure's pixels
Draw = Callable[[Records], Figure]
Scene = tuple[str, str]  # A scenario under a test condition
SCENES = [*product(SCENARIOS, CONDITIONS)]
PAPER_SCENES = [scene for scene in SCENES if scene[1] != "dense"]
SCENE_KEY = "L: left turn, C: congestion, -N: command noise, -V: variant, -D: dense"


def label(scene: Scene) -> str:
    """Return the scene as in the paper's figure 9: L, L-N, L-V, C, ..."""
    scenario, condition = scene
    letter = scenario[0].upper()
    return letter if condition == "nominal" else f"{letter}-{condition[0].upper()}"


COLOURS = {
    "phil_td3": "C3",
    "ia_td3": "C0",
    "hi_td3": "C2",
    "per_td3": "C7",
    plan.HUMAN_MODEL: "C1",
}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black", "C1")
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
MARKERS = {NORMAL: "o", plan.ONE_FRAME: "D", plan.RANDOM: "^", plan.BIASED: "v"}


def _colour(line: Line, place: int) -> str:
    """An algorithm's colour, the same in every figure."""
    return COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)])


def draw_curves(name: str, records: Records) -> Figure:
    """A row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row")
    for panel, (scenario, (kind, metric)) in zip(
        panels.flat, product(SCENARIOS, CURVES), strict=True
    ):
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        for place, line in enumerate(EXPERIMENTS[name].lines):
            units = records.units_of(scenario, line)
            if not units or (metric == REWARD and line.setting == plan.PRINTED):
                continue  # the printed reward is on another scale
            grid = records.grid(scenario)
            curves = np.stack([records.curve(unit, kind, metric, grid) for unit in units])
            middle, std = curves.mean(axis=0), curves.std(axis=0, ddof=min(len(curves) - 1, 1))
            look = {"ls": "-" if line.setting == NORMAL else "--", "color": _colour(line, place)}
            panel.plot(grid, middle, **look, lw=1.8, label=f"{line.name}, seeds: {len(units)}")
            panel.fill_between(
                grid, middle - std, middle + std, color=look["color"], alpha=0.15, lw=0
            )
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(top=1.05 * best)
        panel.grid(alpha=0.3)
        if (kind, metric) == CURVES[-1] and panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


Panel = tuple[str, Sequence[tuple[str, Callable[[Records, Line], Numbers]]], bool]
"""Title, and side by side a place's label with the values of a line there; whether boxes show them
or a point their mean."""


def draw_groups(
    name: str, rows: int, panels: Sequence[Panel], key: str, records: Records
) -> Figure:
    """The lines side by side in each place of each panel."""
    lines = EXPERIMENTS[name].lines
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * rows), layout="constrained")
    axes, width = figure.subplots(rows, len(panels) // rows), 0.8 / len(lines)

    def look(place: int, line: Line) -> dict[str, Any]:  # hollow but in normal
        own = _colour(line, place)
        filled = own if line.setting == NORMAL else "white"
        return {"marker": MARKERS[line.setting], "color": own, "mfc": filled, "ms": 5, "ls": "none"}

    for axis, (title, places, boxes) in zip(axes.flat, panels, strict=True):
        axis.set_title(title, fontsize=10)
        for (group, (_, values_of)), (side, line) in product(enumerate(places), enumerate(lines)):
            x = group + (side - 0.5 * (len(lines) - 1)) * width
            its, values = look(side, line), values_of(records, line)
            if len(values) and boxes:
                axis.boxplot(
                    [values], positions=[x], widths=0.85 * width, patch_artist=True,
                    boxprops={"fc": its["mfc"], "ec": its["color"]}, showfliers=False,
                    medianprops={"color": "black"},
                )  # fmt: skip
            elif len(values):
                std = values.std(ddof=1) if len(values) > 1 else None
                axis.errorbar(x, values.mean(), std, capsize=2, **its)
        axis.set_xticks(range(len(places)), [place for place, _ in places], fontsize=8)
        axis.set_xlim(-0.6, len(places) - 0.4)
        axis.grid(alpha=0.3)
        axis.set_axisbelow(True)
    handles = [Line2D([], [], label=line.name, **look(n, line)) for n, line in enumerate(lines)]
    figure.legend(handles=handles, fontsize=8, ncols=6, loc="outside upper center")
    figure.supxlabel(key, fontsize=8)
    return figure


def _scenes(quantities: Sequence[str], of: Iterable[Scene] = SCENES) -> list[Panel]:
    """A panel for each scenario's scenes, with a quantity for each scenario."""

    def values(scene: Scene, quantity: str) -> Callable[[Records, Line], Numbers]:
        scenario, condition = scene
        if quantity in ARRIVED_ONLY:
            return lambda records, line: records.arrivals(scenario, line, condition)[quantity]
        return lambda records, line: records.of(scenario, line)[f"{quantity} {condition}"]

    return [
        (f"{TITLES[quantity]}, {words(scenario)}",
         [(label(scene), values(scene, quantity)) for scene in of if scene[0] == scenario],
         quantity in ARRIVED_ONLY)
        for scenario, quantity in zip(SCENARIOS, quantities, strict=True)
    ]  # fmt: skip


def _ends() -> list[Panel]:
    """A panel for each curve: where it ends."""

    def values(scenario: str, kind: str, metric: str) -> Callable[[Records, Line], Numbers]:
        return lambda records, line: np.array(
            [records.end(unit, kind, metric) for unit in records.units_of(scenario, line)]
        )

    return [
        (f"{TITLES[metric]}, {kind}", [(words(scenario), values(scenario, kind, metric))], False)
        for scenario, (kind, metric) in product(SCENARIOS, CURVES)
    ]


POINTS, ARRIVALS = "points: mean and standard deviation of the seeds", "drives that arrive"
PAPER_FIGURES: Mapping[str, Draw] = {
    **{name: partial(draw_curves, name)
       for name in ("fig7", "fig11", "fig12", "fig13", "ablation", "printed")},
    **{name: partial(draw_groups, name, rows, panels, key) for name, rows, panels, key in (
        ("fig8", 2, _ends(), POINTS),
        ("fig9", 2, _scenes([SUCCESS] * 2) + _scenes([DISTANCE] * 2), f"{SCENE_KEY}; {POINTS}"),
        ("fig10", 1, _scenes([TIME_S, LATERAL]), f"{SCENE_KEY}; {ARRIVALS}"),
        ("fig14", 1, _scenes([DISTANCE] * 2, PAPER_SCENES), f"{SCENE_KEY}; {POINTS}"),
        ("fig15", 1, _scenes([LONGITUDINAL, LATERAL], PAPER_SCENES), f"{SCENE_KEY}; {ARRIVALS}"),
    )},
}  # fmt: skip
"""Name of the experiment, and of the PNG -> how it is drawn."""


def draw_guidance(records: Records) -> Figure:
    """A panel a task, a dot a seed: the human's seconds until a row learned, and its success."""
    figure = Figure(figsize=(3.3 * len(TASKS) + 1.5, 7.0), layout="constrained")
    panels = figure.subplots(2, len(TASKS), sharey=True)
    heights = -np.arange(len(ROWS))
    for (above, below), task in zip(panels.T, TASKS, strict=True):
        found = [records.of(task, Line(row, GOOD)) for row in ROWS]
        costs = [list(rows[f"human_s_to_{LEARNED:.0%}"]) if row in HELPED else []
                 for row, rows in zip(ROWS, found, strict=True)]  # fmt: skip
        most = max((s for s in chain(*costs) if np.isfinite(s)), default=1.0)
        never = 1.15 * most
        _dots(above, heights, [[min(s, never) for s in each] for each in costs], median_high)
        for row, height in zip(ROWS, heights, strict=True):
            if row not in HELPED:
                above.text(0.02 * most, height, "no human", va="center", fontsize=8)
        above.axvline(1.08 * most, color="0.6", lw=0.8, ls=":")
        above.text(never, 0.8, "never", ha="center", fontsize=8)
        above.set(title=words(task), xlim=(0.0, 1.25 * most))
        above.set_xticks([tick for tick in above.get_xticks() if tick <= most])
        above.set_xlabel(f"seconds of the human until {LEARNED:.0%} alone", fontsize=9)
        _dots(below, heights, [list(100.0 * rows["success nominal"]) for rows in found], mean)
        below.set(xlim=(-4.0, 104.0))
        below.set_xlabel("success, nominal tests, %", fontsize=9)
    for panel in panels[:, 0]:
        panel.set_yticks(heights, [Line(row).name for row in ROWS], fontsize=8)
        panel.set_ylim(heights[-1] - 0.6, 1.6)
    return figure


def _dots(
    panel: Axes,
    heights: Iterable[int],
    rows: Iterable[Sequence[float]],
    middle: Callable[[Sequence[float]], float],
) -> None:
    """A dot for each number of a row, beside one another, and a bar for their middle."""
    panel.grid(axis="x", alpha=0.3)
    for row, height, numbers in zip(ROWS, heights, rows, strict=True):
        colour = "C3" if row == "phil_td3" else "C0"
        panel.axhline(height, color="0.93", lw=0.8, zorder=0)
        if numbers:  # None where a row has no human
            places = height + np.linspace(0.2, -0.2, len(numbers))
            panel.plot(numbers, places, "o", ms=4, alpha=0.55, mew=0, color=colour)
            panel.plot([middle(numbers)] * 2, [height - 0.35, height + 0.35], lw=2, color=colour)


FIGURES: Mapping[str, Mapping[str, Draw]] = {
    "paper": PAPER_FIGURES,
    "guidance": {"guidance": draw_guidance},
}
"""Study -> name of a figure's file -> how it is drawn."""


def write(figure: Figure, path: Path) -> None:
    """Write a PNG of few colours, which takes a third of the bytes."""
    drawn, buffer = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS_PER_INCH)
    picture = Image.open(drawn).convert("RGB").quantize(KEPT_COLOURS, dither=Image.Dither.NONE)
    picture.save(buffer, "png", optimize=True)
    write_atomic(path, buffer.getvalue())
