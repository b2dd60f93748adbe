"""The paper's figures of the kept records: figures 7 to 15, the ablation, the printed settings."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from edge_runtime.files import write_atomic
from trainer.experiments.data import (
    ALONE,
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
    Numbers,
    Results,
    Scene,
    grid_of,
    words,
)
from trainer.experiments.plan import (
    BIASED,
    EXPERIMENTS,
    FOUR,
    FULL_PATH_M,
    GUIDED,
    HUMAN_MODEL,
    NORMAL,
    ONE_FRAME,
    PRINTED,
    RANDOM,
    SCENARIOS,
)
from trainer.experiments.statistics import paired_t, stars

DOTS_PER_INCH = 110
COLOURS = {"phil_td3": "C3", "ia_td3": "C0", "hi_td3": "C2", "per_td3": "C7", HUMAN_MODEL: "C1"}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black")
"""For algorithms without a colour of their own, by their place in the figure."""
CURVES = ((TRAINING, REWARD), (TRAINING, DISTANCE), (ALONE, SUCCESS), (ALONE, DISTANCE))
TITLES = {REWARD: "reward", DISTANCE: "surviving distance, m", SUCCESS: "success"}
BOXES = {
    "left_turn": (TIME_S, "time to the goal, s"),
    "congestion": (LATERAL, "mean |lateral acceleration|, m/s²"),
}
SMOOTHNESS = {
    "left_turn": (LONGITUDINAL, "mean |longitudinal acceleration|, m/s²"),
    "congestion": BOXES["congestion"],
}
HATCHED = {"alpha": 0.45, "hatch": "//"}
LEGEND: dict[str, Any] = {"fontsize": 8, "ncols": 6, "loc": "outside upper center"}
SCENE_KEY = "L: left turn, C: congestion, -N: command noise, -V: variant, -D: dense"


def colour(line: Line, place: int = 0) -> str:
    """An algorithm's colour, the same in every figure."""
    return COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)])


def _counted(results: Results, scenario: str, line: Line) -> str:
    count = len(results.of(scenario, line))
    return line.name + ("" if count == results.seeds else f" ({count} of {results.seeds} seeds)")


def _curve_panels(figure: Figure, **options: Any) -> Iterator[tuple[Any, str, str, str]]:
    """A panel for each scenario and curve, with its title: panel, scenario, kind, metric."""
    panels = figure.subplots(2, len(CURVES), **options)
    for panel, (scenario, (kind, metric)) in zip(
        panels.flat, product(SCENARIOS, CURVES), strict=True
    ):
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        yield panel, scenario, kind, metric


def draw_curves(results: Results, lines: Sequence[Line]) -> Figure:
    """A row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    for panel, scenario, kind, metric in _curve_panels(figure, sharex="row"):
        for place, line in enumerate(lines):
            if metric == REWARD and line.setting == PRINTED:
                continue  # on another scale
            found, named = results.of(scenario, line), _counted(results, scenario, line)
            look = {"ls": "-" if line.setting == NORMAL else "--", "color": colour(line, place)}
            if not found:
                panel.plot([], [], **look, alpha=0.4, label=named)
                continue
            curves = np.stack([result.curve(kind, metric) for result in found])
            grid, mean, spread = grid_of(found[0].budget), curves.mean(axis=0), curves.std(axis=0)
            panel.plot(grid, mean, **look, lw=1.8, label=named)
            panel.fill_between(
                grid, mean - spread, mean + spread, color=look["color"], alpha=0.15, lw=0
            )
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(0.0, 1.05 * best)
        _finish(panel)
        if (kind, metric) == CURVES[-1]:
            panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_settings(results: Results, algorithms: Sequence[str], other: str) -> Figure:
    """Where the trainings end, in the normal setting and in another one; number: the ratio."""
    figure = Figure(figsize=(16.0, 6.4), layout="constrained")
    for panel, scenario, kind, metric in _curve_panels(figure):
        for place, algorithm in enumerate(algorithms):
            means = []
            for side, setting in ((-0.2, NORMAL), (0.2, other)):
                line = Line(algorithm, setting)
                ends = list(results.numbers(scenario, line, metric, kind).values())
                if not ends:
                    continue
                means.append(float(np.mean(ends)))
                look = HATCHED if setting == other else {}
                panel.bar(place + side, means[-1], 0.38, yerr=np.std(ends), capsize=3,
                          color=colour(line), **look)  # fmt: skip
            if len(means) == 2 and means[0] > 0.0 and metric != REWARD:
                ratio = f"{means[1] / means[0]:.2f}\n"
                panel.text(place + 0.2, means[1], ratio, ha="center", fontsize=8)
        _finish(panel, [Line(name).name for name in algorithms])
    figure.supxlabel(
        f"plain: normal; hatched: {words(other)}; number: ratio; "
        "bar: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_tests(results: Results, algorithms: Sequence[str]) -> Figure:
    """Success in all scenes, and surviving distances with paired t-tests against the first."""
    figure = Figure(figsize=(14.0, 5.6), layout="constrained")
    heat, *bars = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1.2))
    lines = [Line(name) for name in algorithms]
    shares = np.full((len(SCENES), len(lines)), np.nan)
    for (row, scene), (column, line) in product(enumerate(SCENES), enumerate(lines)):
        reached = results.pooled(scene, line, SUCCESS)
        if len(reached):
            shares[row, column] = share = reached.mean()
            heat.text(column, row, f"{100 * share:.0f} %", ha="center", va="center", fontsize=9,
                      color="white" if share > 0.6 else "black")  # fmt: skip
    heat.imshow(shares, cmap="YlGn", vmin=0.0, vmax=1.0, aspect="auto")
    heat.set_xticks(range(len(lines)), [line.name for line in lines], fontsize=7, rotation=20)
    heat.set_yticks(range(len(SCENES)), [scene.label for scene in SCENES])
    heat.set_title("success", fontsize=10)
    for panel, scenario in zip(bars, SCENARIOS, strict=True):
        panel.set_title(f"{words(scenario)}: surviving distance, m", fontsize=10)
        width = 0.8 / len(lines)
        for group, scene, place, line in _groups(panel, scenario, lines):
            values = results.pooled(scene, line, DISTANCE)
            if not len(values):
                continue
            x = group + (place - 0.5 * (len(lines) - 1)) * width
            named = None if group else line.name
            panel.bar(x, values.mean(), width, yerr=values.std(), capsize=2, error_kw={"lw": 0.8},
                      color=colour(line, place), label=named)  # fmt: skip
            mark = _stars(results, scene, lines[0], line, DISTANCE) if place else ""
            panel.text(x, 1.2 * FULL_PATH_M[scenario], mark, ha="center", fontsize=8, rotation=90)
        panel.set_ylim(0.0, 1.35 * FULL_PATH_M[scenario])
    figure.legend(*bars[0].get_legend_handles_labels(), **LEGEND)
    figure.supxlabel(
        f"{SCENE_KEY}; error bar: standard deviation over all drives; nothing beyond the "
        "goal counts\nstars: paired t-test against PHIL-TD3 over all drives of all seeds",
        fontsize=8,
    )
    return figure


def _groups(
    panel: Any, scenario: str, lines: Sequence[Line]
) -> Iterator[tuple[int, Scene, int, Line]]:
    """The lines in each scene of a scenario, both numbered; then the panel is finished."""
    scenes = [scene for scene in SCENES if scene.scenario == scenario]
    for (group, scene), (place, line) in product(enumerate(scenes), enumerate(lines)):
        yield group, scene, place, line
    _finish(panel, [scene.label for scene in scenes])


def _stars(results: Results, scene: Scene, first: Line, second: Line, quantity: str) -> str:
    """Of the paired t-test over the drives that seeds of both have; arrivals where time counts."""
    pairs: list[tuple[Numbers, Numbers]] = []
    others = {result.unit.seed: result for result in results.of(scene.scenario, second)}
    for result in results.of(scene.scenario, first):
        other = others.get(result.unit.seed, others.get(0))
        if other is not None:
            both = result.reached(scene.condition) & other.reached(scene.condition)
            kept = both if quantity != DISTANCE else np.ones_like(both)
            own, its = (each.drives(scene.condition, quantity)[kept] for each in (result, other))
            pairs.append((own, its))
    if not pairs:
        return ""
    own, its = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return stars(paired_t(own, its))


def draw_boxes(results: Results, algorithms: Sequence[str]) -> Figure:
    """Time in the left turn and smoothness in the congestion, of the drives that arrive."""
    figure = Figure(figsize=(13.0, 5.0), layout="constrained")
    lines = [Line(name) for name in algorithms]
    for panel, scenario in zip(figure.subplots(1, 2), SCENARIOS, strict=True):
        quantity, title = BOXES[scenario]
        panel.set_title(f"{words(scenario)}: {title}", fontsize=10)
        for group, scene, place, line in _groups(panel, scenario, lines):
            arrived = results.pooled(scene, line, SUCCESS) > 0.0
            values = results.pooled(scene, line, quantity)[arrived]
            if not len(values):
                continue
            x = group + (place - 1.5) * 0.2
            boxes = panel.boxplot([values], positions=[x], widths=0.17, patch_artist=True,
                                  flierprops={"ms": 2}, medianprops={"color": "black"})  # fmt: skip
            boxes["boxes"][0].set(facecolor=colour(line), alpha=0.7)
            mark = _stars(results, scene, lines[0], line, quantity) if place else ""
            panel.text(
                x, 0.96, mark, transform=panel.get_xaxis_transform(), ha="center", fontsize=8
            )
        named = [Patch(fc=colour(line), label=_counted(results, scenario, line)) for line in lines]
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.06)}
        panel.legend(handles=named, fontsize=8, ncols=4, **below)
        panel.margins(y=0.12)
    figure.supxlabel(
        f"{SCENE_KEY}; drives that arrive; stars: paired t-test against PHIL-TD3 where both arrive",
        fontsize=8,
    )
    return figure


def draw_guidance(results: Results, algorithms: Sequence[str]) -> Figure:
    """Mean surviving distance after good and poor guidance, as shares of their sum."""
    figure = Figure(figsize=(14.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(algorithms), sharey=True)
    for panel, (setting, algorithm) in zip(
        panels.flat, product((RANDOM, BIASED), algorithms), strict=True
    ):
        lines = Line(algorithm), Line(algorithm, setting)
        panel.set_title(lines[1].name, fontsize=10)
        for place, scene in enumerate(PAPER_SCENES):
            pooled = [results.pooled(scene, line, DISTANCE) for line in lines]
            if not all(map(len, pooled)):
                continue
            means_m, bottom = [values.mean() for values in pooled], 0.0
            for mean_m, look in zip(means_m, ({}, HATCHED), strict=True):
                share = mean_m / sum(means_m)
                panel.bar(place, share, bottom=bottom, color=colour(lines[1]), **look)
                text = f"{100 * share:.1f} %\n{mean_m:.1f} m"
                panel.text(place, bottom + share / 2, text, ha="center", va="center", fontsize=7,
                           bbox={"fc": "white", "alpha": 0.7, "lw": 0})  # fmt: skip
                bottom += share
        panel.axhline(0.5, color="black", lw=0.8, ls=":")
        panel.set_ylim(0.0, 1.0)
        _finish(panel, [scene.label for scene in PAPER_SCENES])
    figure.supxlabel(f"below: good guidance; hatched: poor; {SCENE_KEY}", fontsize=8)
    return figure


def draw_distributions(results: Results, algorithms: Sequence[str]) -> Figure:
    """How often each mean acceleration occurs: after poor guidance solid, after good dotted."""
    figure = Figure(figsize=(14.0, 6.8), layout="constrained")
    panels = figure.subplots(2, 3)
    lines = [Line(name, setting) for name, setting in product(algorithms, (RANDOM, NORMAL))]
    for panel, scene in zip(panels.flat, PAPER_SCENES, strict=True):
        quantity, title = SMOOTHNESS[scene.scenario]
        panel.set_title(scene.label, fontsize=10)
        panel.set_xlabel(title, fontsize=8)
        found = {line: results.pooled(scene, line, quantity) for line in lines}
        everything = np.concatenate([np.zeros(1), *found.values()])
        edges = np.linspace(everything.min(), everything.max() + 1e-9, 31)
        for line, values in found.items():
            if not len(values):
                continue
            style = {"ls": ":", "lw": 1.0} if line.setting == NORMAL else {"ls": "-", "lw": 1.6}
            shares = np.histogram(values, edges)[0] / len(values)
            panel.stairs(shares, edges, color=colour(line), label=line.name, **style)
        _finish(panel)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), **LEGEND)
    figure.supxlabel("share of all test drives", fontsize=8)
    return figure


def _finish(panel: Any, names: Sequence[str] = ()) -> None:
    """Grid and ticks; an empty panel says that it is empty."""
    if names:
        panel.set_xticks(range(len(names)), names, fontsize=8)
        panel.set_xlim(-0.6, len(names) - 0.4)
    panel.grid(alpha=0.3)
    panel.set_axisbelow(True)
    if not panel.has_data():
        panel.text(0.5, 0.5, "no data yet", ha="center", color="0.5", transform=panel.transAxes)


def _curves_of(name: str) -> Callable[[Results], Figure]:
    one = EXPERIMENTS[name]
    pairs = product(one.settings, one.algorithms)
    return partial(draw_curves, lines=[Line(algorithm, setting) for setting, algorithm in pairs])


FIGURES: Mapping[str, Callable[[Results], Figure]] = {
    "fig7": _curves_of("fig7"),
    "fig8": partial(draw_settings, algorithms=FOUR, other=ONE_FRAME),
    "fig9": partial(draw_tests, algorithms=EXPERIMENTS["fig9"].algorithms),
    "fig10": partial(draw_boxes, algorithms=FOUR),
    **{name: _curves_of(name) for name in ("fig11", "fig12", "fig13")},
    "fig14": partial(draw_guidance, algorithms=GUIDED),
    "fig15": partial(draw_distributions, algorithms=GUIDED),
    **{name: _curves_of(name) for name in ("ablation", "printed")},
}
"""Name of the experiment, and of the PNG -> how it is drawn."""


def write_figure(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH)
    write_atomic(path, buffer.getvalue())
