"""Figures of the studies."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from edge_runtime.files import write_atomic
from trainer.environments import CONDITIONS
from trainer.experiments import plan
from trainer.experiments import records as data
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
from trainer.experiments.records import ALONE, DISTANCE, REWARD, SUCCESS, TRAINING, Records
from trainer.training.metrics import DOTS_PER_INCH

KEPT_COLOURS = 64  # Of a figure's pixels
Draw = Callable[[Records], Figure]
Scene = tuple[str, str]  # A scenario under a test condition
SCENES = [*product(SCENARIOS, CONDITIONS)]
PAPER_SCENES = [scene for scene in SCENES if scene[1] != "dense"]
SCENE_KEY = "L: left turn, C: congestion, -N: command noise, -V: variant, -D: dense"
COLOURS = {
    "phil_td3": "C3",
    "ia_td3": "C0",
    "hi_td3": "C2",
    "per_td3": "C7",
    plan.HUMAN_MODEL: "C1",
}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black", "C1")
"""For algorithms without a colour of their own, by their place in the figure."""
CURVES = ((REWARD, TRAINING), (DISTANCE, TRAINING), (SUCCESS, ALONE), (DISTANCE, ALONE))
TITLES = {
    REWARD: "reward",
    DISTANCE: "surviving distance, m",
    SUCCESS: "success",
    data.TIME_S: "time to the goal, s",
    data.LATERAL: "mean |lateral acceleration|, m/s²",
    data.LONGITUDINAL: "mean |longitudinal acceleration|, m/s²",
}
MARKERS = {NORMAL: "o", plan.ONE_FRAME: "D", plan.RANDOM: "^", plan.BIASED: "v"}


def label(scene: Scene) -> str:
    """Return the scene as in the paper's figure 9: L, L-N, L-V, C, ..."""
    letter, condition = scene[0][0].upper(), scene[1]
    return letter if condition == "nominal" else f"{letter}-{condition[0].upper()}"


def _colour(line: Line, place: int) -> str:
    return COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)])


def draw_curves(name: str, records: Records) -> Figure:
    """A row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row").flat
    for panel, (scenario, curve) in zip(panels, product(SCENARIOS, CURVES), strict=True):
        metric, kind = curve
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        for place, line in enumerate(EXPERIMENTS[name].lines):
            curves = records.curves(scenario, line, f"{metric} {kind}")
            if not len(curves) or (metric == REWARD and line.setting == plan.PRINTED):
                continue  # the printed reward is on another scale
            grid, colour = records.grid(scenario), _colour(line, place)
            middle, std = curves.mean(axis=0), curves.std(axis=0, ddof=min(len(curves) - 1, 1))
            style, title = "-" if line.setting == NORMAL else "--", f"{line.name}, seeds: "
            panel.plot(grid, middle, style, color=colour, lw=1.8, label=f"{title}{len(curves)}")
            panel.fill_between(grid, middle - std, middle + std, color=colour, alpha=0.15, lw=0)
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(top=1.05 * best)
        panel.grid(alpha=0.3)
        if curve == CURVES[-1] and panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


Panel = tuple[str, str, Sequence[tuple[str, str]]]
"""Quantity and scenario, and side by side a place's label and what follows the quantity's name."""


def draw_groups(
    name: str, panels: Sequence[Panel], rows: int, key: str, records: Records
) -> Figure:
    """The lines side by side in each place of each panel, boxes of what arrives or a mean."""
    lines = EXPERIMENTS[name].lines
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * rows), layout="constrained")
    axes, width = figure.subplots(rows, len(panels) // rows), 0.8 / len(lines)

    def look(place: int, line: Line) -> dict[str, Any]:  # hollow but in normal
        own = _colour(line, place)
        filled = own if line.setting == NORMAL else "white"
        return {"marker": MARKERS[line.setting], "color": own, "mfc": filled, "ms": 5, "ls": "none"}

    for axis, (quantity, scenario, places) in zip(axes.flat, panels, strict=True):
        kind = places[0][1].partition(",")[0]
        about = kind if kind in (TRAINING, ALONE) else words(scenario)
        axis.set_title(f"{TITLES[quantity]}, {about}", fontsize=10)
        for (group, (_, where)), (side, line) in product(enumerate(places), enumerate(lines)):
            x = group + (side - 0.5 * (len(lines) - 1)) * width
            its, boxes = look(side, line), quantity in data.ARRIVED_ONLY
            values = (records.arrivals(scenario, line, where)[quantity] if boxes
                      else records.of(scenario, line)[f"{quantity} {where}"])  # fmt: skip
            if len(values) and boxes:
                axis.boxplot(
                    [values], positions=[x], widths=0.85 * width, patch_artist=True,
                    boxprops={"fc": its["mfc"], "ec": its["color"]}, showfliers=False,
                    medianprops={"color": "black"},
                )  # fmt: skip
            elif len(values):
                std = values.std() if len(values) > 1 else None
                axis.errorbar(x, values.mean(), std, capsize=2, **its)
        axis.set_xticks(range(len(places)), [place for place, _ in places], fontsize=8)
        axis.set_xlim(-0.6, len(places) - 0.4)
        axis.grid(alpha=0.3)
        axis.set_axisbelow(True)
    handles = [Line2D([], [], label=line.name, **look(n, line)) for n, line in enumerate(lines)]
    figure.legend(handles=handles, fontsize=8, ncols=6, loc="outside upper center")
    figure.supxlabel(key, fontsize=8)
    return figure


def _scenes(*quantities: str, of: Iterable[Scene] = SCENES) -> list[Panel]:
    """A panel for each scenario's scenes, with a quantity for each scenario."""
    return [
        (quantity, scenario, [(label(scene), scene[1]) for scene in of if scene[0] == scenario])
        for scenario, quantity in zip(SCENARIOS, quantities, strict=True)
    ]


ENDS: list[Panel] = [
    (metric, scenario, [(words(scenario), f"{kind}, end")])
    for scenario, (metric, kind) in product(SCENARIOS, CURVES)
]
"""Where each curve ends."""
POINTS, ARRIVALS = "points: mean and standard deviation of the seeds", "drives that arrive"
PAPER_FIGURES: Mapping[str, Draw] = {
    **{name: partial(draw_curves, name)
       for name in ("fig7", "fig11", "fig12", "fig13", "ablation", "printed")},
    **{name: partial(draw_groups, name, panels, rows, key) for name, panels, rows, key in (
        ("fig8", ENDS, 2, POINTS),
        ("fig9", [*_scenes(SUCCESS, SUCCESS), *_scenes(DISTANCE, DISTANCE)], 2,
         f"{SCENE_KEY}; {POINTS}"),
        ("fig10", _scenes(data.TIME_S, data.LATERAL), 1, f"{SCENE_KEY}; {ARRIVALS}"),
        ("fig14", _scenes(DISTANCE, DISTANCE, of=PAPER_SCENES), 1, f"{SCENE_KEY}; {POINTS}"),
        ("fig15", _scenes(data.LONGITUDINAL, data.LATERAL, of=PAPER_SCENES), 1,
         f"{SCENE_KEY}; {ARRIVALS}"),
    )},
}  # fmt: skip
"""Name of the experiment, and of the PNG -> how it is drawn."""


def draw_guidance(records: Records) -> Figure:
    """A panel a task, a dot a seed: the human's seconds until a row learned, and its success."""
    figure = Figure(figsize=(3.3 * len(TASKS) + 1.5, 7.0), layout="constrained")
    panels = figure.subplots(2, len(TASKS), sharey=True)
    heights = -np.arange(len(ROWS))
    for panel in panels.flat:
        panel.grid(axis="x", alpha=0.3)
    for (above, below), task in zip(panels.T, TASKS, strict=True):
        found = [records.of(task, Line(row, GOOD)) for row in ROWS]
        learned = [rows[f"human_s_to_{data.LEARNED:.0%}"] for rows in found]
        costs = [s[s < np.inf] for row, s in zip(ROWS, learned, strict=True) if row in HELPED]
        most = max((s.max() for s in costs if len(s)), default=1.0)
        never = 1.15 * most
        for row, height, rows, human_s in zip(ROWS, heights, found, learned, strict=True):
            colour = "C3" if row == "phil_td3" else "C0"
            success, cut = 100.0 * rows["success nominal"], human_s.clip(upper=never)
            numbers = [(below, success, success.mean())]
            if row in HELPED:
                numbers.append((above, cut, cut.quantile(interpolation="higher")))
            else:
                above.text(0.02 * most, height, "no human", va="center", fontsize=8)
            for panel in (above, below):
                panel.axhline(height, color="0.93", lw=0.8, zorder=0)
            for panel, dots, middle in numbers:
                places = height + np.linspace(0.2, -0.2, len(dots))
                panel.plot(dots, places, "o", ms=4, alpha=0.55, mew=0, color=colour)
                ends = [height - 0.35, height + 0.35]
                panel.plot([middle] * 2, ends, lw=2, color=colour)
        above.axvline(1.08 * most, color="0.6", lw=0.8, ls=":")
        above.text(never, 0.8, "never", ha="center", fontsize=8)
        above.set(title=words(task), xlim=(0.0, 1.25 * most))
        above.set_xticks([tick for tick in above.get_xticks() if tick <= most])
        above.set_xlabel(f"seconds of the human until {data.LEARNED:.0%} alone", fontsize=9)
        below.set(xlim=(-4.0, 104.0))
        below.set_xlabel("success, nominal tests, %", fontsize=9)
    for panel in panels[:, 0]:
        panel.set_yticks(heights, [Line(row).name for row in ROWS], fontsize=8)
        panel.set_ylim(heights[-1] - 0.6, 1.6)
    return figure


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
