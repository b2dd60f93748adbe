"""Bars of two settings side by side (fig. 8), of scenes (fig. 9) and of guidance (fig. 14)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from trainer.experiments.figures.style import (
    SCENE_KEY,
    colour,
    letter,
    new_figure,
    note_missing,
    short,
)
from trainer.experiments.gathered import Gathered, pairs, pooled
from trainer.experiments.outcome import within_path
from trainer.experiments.plan import (
    FULL_PATH_M,
    NORMAL,
    POOR,
    SCENARIO_TITLES,
    SCENES,
    TOUGH,
    Scene,
)
from trainer.experiments.progress import DISTANCES, NAMED, final
from trainer.experiments.statistics import paired_t, stars


def draw_difficulty(gathered: Gathered, algorithms: Sequence[str]) -> Figure:
    """Final averages in the normal and the tough setting; of distances, the ratio of the two."""
    figure = new_figure(18.0, 6.6)
    panels = figure.subplots(len(SCENARIO_TITLES), len(NAMED))
    for number, (scenario, metric) in enumerate(product(SCENARIO_TITLES, NAMED)):
        panel = panels.flat[number]
        letter(panel, number, f"{NAMED[metric]}, {SCENARIO_TITLES[scenario]}")
        _difficulty_panel(panel, gathered, algorithms, scenario, metric)
    return figure


def _difficulty_panel(
    panel: Any, gathered: Gathered, algorithms: Sequence[str], scenario: str, metric: str
) -> None:
    names = []
    for place, algorithm in enumerate(algorithms):
        means, tops, counts = {}, [], []
        for side, setting in ((-0.2, NORMAL), (0.2, TOUGH)):
            outcomes = gathered.of(scenario, algorithm, setting)
            counts.append(len(outcomes))
            if not outcomes:
                continue
            finals = [final(outcome, metric) for outcome in outcomes]
            means[setting] = float(np.mean(finals))
            tops.append(means[setting] + float(np.std(finals)))
            panel.bar(
                place + side, means[setting], 0.38, yerr=np.std(finals), capsize=3,
                color=colour(algorithm), alpha=1.0 if setting == NORMAL else 0.45,
                hatch=None if setting == NORMAL else "//",
            )  # fmt: skip
        # Of rewards, which may be negative, and of no success, a ratio says nothing.
        if len(means) == 2 and metric in DISTANCES and means[NORMAL] > 0.0:
            text = f"{means[TOUGH] / means[NORMAL]:.2f}"
            panel.annotate(
                text, (place, max(tops)), (0, 5), textcoords="offset points", ha="center",
                fontsize=9,
            )  # fmt: skip
        names.append(f"{short(algorithm)}\n{counts[0]} + {counts[1]} seeds")
    _finish(panel, names, bool(panel.patches))
    if metric != "episode_return":
        panel.set_ylim(bottom=0.0)
    ratio = "; number: ratio" if metric in DISTANCES else ""
    panel.set_xlabel(f"left: normal; right, hatched: tough (one frame){ratio}", fontsize=8)


def draw_tests(gathered: Gathered, algorithms: Sequence[str]) -> Figure:
    """Heat map of success, and bars of surviving distance with paired t-tests against the first."""
    figure = new_figure(13.0, 5.4)
    heat, left, right = figure.subplots(1, 3, width_ratios=(1.05, 1.2, 1.2))
    _heat_map(heat, gathered, algorithms)
    for number, (panel, scenario) in enumerate(((left, "left_turn"), (right, "congestion")), 1):
        letter(panel, number, f"surviving distance, m, {SCENARIO_TITLES[scenario]}")
        scenes = [scene for scene in SCENES if scene.scenario == scenario]
        _distance_bars(panel, gathered, algorithms, scenes)
    figure.supxlabel(
        f"{SCENE_KEY}\n"
        "error bar: standard deviation; dotted: the goal, beyond which a car may drive one step\n"
        "stars: paired t-test against PHIL-TD3 over all drives of all seeds, cut at the goal",
        fontsize=8,
    )
    return figure


def _heat_map(panel: Any, gathered: Gathered, algorithms: Sequence[str]) -> None:
    shares = np.full((len(SCENES), len(algorithms)), np.nan)
    for row, scene in enumerate(SCENES):
        for column, algorithm in enumerate(algorithms):
            outcomes = gathered.tested(scene, algorithm)
            if outcomes:
                reached = [outcome.tests[scene.condition].reached for outcome in outcomes]
                shares[row, column] = np.mean(np.concatenate(reached))
            share = shares[row, column]
            missing = np.isnan(share)
            fewer = len(outcomes) < gathered.seeds
            seeds = f"\n{len(outcomes)} of {gathered.seeds} seeds" if fewer else ""
            text = "–" if missing else f"{100 * share:.0f}%{seeds}"
            dark = not missing and share > 0.6
            panel.text(column, row, text, ha="center", va="center", fontsize=9,
                       color="white" if dark else "black")  # fmt: skip
    panel.imshow(shares, cmap="YlGn", vmin=0.0, vmax=1.0, aspect="auto")
    panel.set_facecolor("0.92")
    panel.set_xticks(range(len(algorithms)), [short(name) for name in algorithms], fontsize=8)
    panel.set_yticks(range(len(SCENES)), [scene.label for scene in SCENES])
    letter(panel, 0, f"success rate, {gathered.seeds} seeds")


def _distance_bars(
    panel: Any, gathered: Gathered, algorithms: Sequence[str], scenes: Sequence[Scene]
) -> None:
    width = 0.8 / len(algorithms)
    full_m = FULL_PATH_M[scenes[0].scenario]
    for group, scene in enumerate(scenes):
        own = gathered.tested(scene, algorithms[0])
        for place, algorithm in enumerate(algorithms):
            outcomes = gathered.tested(scene, algorithm)
            distances_m = pooled(outcomes, scene.condition, "distance_m")
            if not len(distances_m):
                continue
            x = group + (place - 0.5 * (len(algorithms) - 1)) * width
            panel.bar(
                x, distances_m.mean(), width, yerr=distances_m.std(), capsize=2,
                color=colour(algorithm), label=short(algorithm), error_kw={"lw": 0.8},
            )  # fmt: skip
            first, second = pairs(own, outcomes, scene.condition, "distance_m")
            first, second = (within_path(scene.scenario, values) for values in (first, second))
            if place and len(first):
                panel.text(x, 1.16 * full_m, stars(paired_t(first, second)),
                           ha="center", va="bottom", fontsize=8, rotation=90)  # fmt: skip
    panel.axhline(full_m, color="0.5", lw=0.8, ls=":")
    panel.set_ylim(0.0, 1.36 * full_m)
    _finish(panel, [scene.label for scene in scenes], bool(panel.patches))
    handles, names = panel.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    if once:
        panel.legend(
            once.values(), once.keys(), fontsize=7, ncols=len(once), loc="upper center",
            bbox_to_anchor=(0.5, -0.12),
        )  # fmt: skip


def draw_guidance(gathered: Gathered, algorithms: Sequence[str]) -> Figure:
    """Stacked bars of the mean surviving distance under good and poor guidance (fig. 14)."""
    figure = new_figure(13.0, 4.2)
    for number, (panel, algorithm) in enumerate(
        zip(figure.subplots(1, len(algorithms), sharey=True), algorithms, strict=True)
    ):
        letter(panel, number, short(algorithm))
        counts = []
        for place, scene in enumerate(SCENES):
            means_m = []
            for setting in (NORMAL, POOR):
                outcomes = gathered.tested(scene, algorithm, setting)
                distances_m = within_path(
                    scene.scenario, pooled(outcomes, scene.condition, "distance_m")
                )
                means_m.append(float(distances_m.mean()) if len(distances_m) else float("nan"))
                counts.append(len(outcomes))
            if np.isnan(means_m).any():
                continue
            if not sum(means_m):
                continue
            good, poor = (mean_m / sum(means_m) for mean_m in means_m)
            panel.bar(place, good, color=colour(algorithm))
            panel.bar(place, poor, bottom=good, color=colour(algorithm), alpha=0.45, hatch="//")
            for share, middle, mean_m in (
                (good, good / 2, means_m[0]),
                (poor, 1 - poor / 2, means_m[1]),
            ):
                panel.text(
                    place, middle, f"{100 * share:.1f}%\n{mean_m:.1f} m", ha="center", va="center",
                    fontsize=7, bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 1},
                )  # fmt: skip
        panel.axhline(0.5, color="k", lw=0.8, ls=":")
        _finish(panel, [scene.label for scene in SCENES], bool(panel.patches))
        panel.set_xlim(-0.6, len(SCENES) - 0.4)
        panel.set_ylim(0.0, 1.0)
        fewest, most = min(counts), max(counts)
        seeds = f"{most} seeds" if fewest == most else f"{fewest} to {most} seeds"
        panel.set_xlabel(f"below: good guidance; hatched: poor; {seeds}", fontsize=8)
    figure.supylabel(
        "share of the two mean surviving distances\n(nothing beyond the goal counted)", fontsize=9
    )
    figure.supxlabel(SCENE_KEY, fontsize=8)
    return figure


def _finish(panel: Any, names: Sequence[str], drawn: bool) -> None:
    panel.set_xticks(range(len(names)), names, fontsize=8)
    panel.set_xlim(-0.6, len(names) - 0.4)
    panel.grid(alpha=0.3, axis="y")
    panel.set_axisbelow(True)
    panel.margins(y=0.15)
    if not drawn:
        note_missing(panel)
