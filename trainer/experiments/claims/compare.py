"""Comparisons that several experiments share; all are paired by training seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trainer.experiments.figures.curves import TITLES, Line
from trainer.experiments.gathered import Gathered, Outcome, pairs, pooled
from trainer.experiments.plan import HUMAN_MODEL, SCENARIO_TITLES, Scene
from trainer.experiments.statistics import (
    Estimate,
    Numbers,
    above,
    all_of,
    efficiency,
    final_average,
    mean_estimate,
    smoothed,
    success_estimate,
)
from trainer.experiments.verdict import Claim, claim

BY_SEED = "95 % interval of the difference, paired by seed"
BY_EPISODE = "95 % interval over these policies' test episodes, paired by training and test seed"
BY_BOOTSTRAP = "95 % bootstrap interval over the seeds"
BY_WILSON = "Wilson's 95 % intervals do not overlap"
BY_VALUE = "the value itself"


def finals(gathered: Gathered, scenario: str, line: Line, metric: str) -> dict[int, float]:
    """Training seed -> final average of a training metric."""
    outcomes = gathered.of(scenario, line.algorithm, line.setting)
    return {outcome.unit.seed: final_average(outcome.curve(metric)) for outcome in outcomes}


def difference(first: Mapping[int, float], second: Mapping[int, float]) -> Estimate:
    """Mean of first minus second over the seeds that both have."""
    return mean_estimate([first[seed] - second[seed] for seed in first if seed in second])


def complete(gathered: Gathered, scenario: str, lines: Sequence[Line]) -> bool:
    """Whether all units of these lines are there."""
    return all(gathered.complete(scenario, [one.algorithm], one.setting) for one in lines)


def final_claim(
    gathered: Gathered,
    scenario: str,
    metric: str,
    ours: Line,
    others: Sequence[Line],
    text: str,
    paper: str = "highest",
) -> Claim:
    """Whether one line ends above each of the others."""
    own = finals(gathered, scenario, ours, metric)
    ends = {line: finals(gathered, scenario, line, metric) for line in others}
    differences = [difference(own, end) for end in ends.values()]
    shown = [f"{line.label} {mean_estimate(list(end.values())).text()}"
             for line, end in {ours: own, **ends}.items()]  # fmt: skip
    return claim(
        f"{SCENARIO_TITLES[scenario]}, {TITLES[metric]}: {text}",
        paper,
        ", ".join(shown),
        all_of([above(each) for each in differences]),
        min(each.size for each in differences),
        f"final averages; {BY_SEED}",
        min(differences, key=lambda each: each.low),
        complete(gathered, scenario, [ours, *others]),
    )


def speed_claim(
    gathered: Gathered,
    scenario: str,
    metric: str,
    ours: Line,
    other: Line,
    text: str,
    paper: str,
    least: float = 1.0,
    common: bool = False,
    also: Sequence[Line] = (),
) -> Claim:
    """Whether one line gets ``least`` times as soon where another one ends.

    With ``common`` the level is the lower of both ends instead, so that both can reach it. ``also``
    are lines among which ``other`` was chosen: they must be complete, too.
    """
    own, theirs = (curves(gathered, scenario, line, metric) for line in (ours, other))
    text = f"{SCENARIO_TITLES[scenario]}, {TITLES[metric]}: {text}"
    if own is None or theirs is None:
        return claim(text, paper, "", "undecided", 0, BY_BOOTSTRAP, None, False)
    found = efficiency(own, theirs, common)
    return claim(
        text,
        paper,
        f"{found.ratio.text(1)} times as soon: {ours.label} {found.episodes:.0f} episodes, "
        f"{other.label} {found.baseline_episodes:.0f}",
        above(found.ratio, least),
        found.ratio.size,
        f"smoothed means; {BY_BOOTSTRAP}",
        found.ratio,
        complete(gathered, scenario, [ours, other, *also]),
    )


def curves(gathered: Gathered, scenario: str, line: Line, metric: str) -> Numbers | None:
    """Smoothed curves float [seeds, episodes]; None without any."""
    outcomes = gathered.of(scenario, line.algorithm, line.setting)
    return smoothed([outcome.curve(metric) for outcome in outcomes]) if outcomes else None


def best_line(gathered: Gathered, scenario: str, metric: str, lines: Sequence[Line]) -> Line:
    """The line with the highest final average; the first where there is none at all."""
    ends = {line: finals(gathered, scenario, line, metric).values() for line in lines}
    return max(lines, key=lambda line: np.mean(list(ends[line])) if ends[line] else -np.inf)


def success(outcomes: Sequence[Outcome], condition: str) -> Estimate:
    """Success over all test episodes of some outcomes."""
    reached = [outcome.tests[condition].reached for outcome in outcomes]
    return success_estimate(int(sum(map(np.sum, reached))), sum(map(len, reached)))


def scene_difference(
    gathered: Gathered,
    scene: Scene,
    first: Line,
    second: Line,
    quantity: str,
    arrived: bool = False,
) -> Estimate:
    """First minus second over paired test episodes."""
    own, theirs = (gathered.tested(scene, line.algorithm, line.setting) for line in (first, second))
    values, others = pairs(own, theirs, scene.condition, quantity, arrived)
    return mean_estimate(values - others)


def scene_claim(
    gathered: Gathered,
    scene: Scene,
    quantity: str,
    ours: Line,
    others: Sequence[Line],
    text: str,
    paper: str,
    sign: float = 1.0,
    arrived: bool = False,
) -> Claim:
    """Whether one line's mean over test episodes is above (sign 1) or below (-1) all others'."""
    lines = [ours, *others]
    differences = [
        scene_difference(gathered, scene, ours, line, quantity, arrived) for line in others
    ]
    decisive = min(differences, key=lambda each: min(sign * each.low, sign * each.high))
    shown = [f"{line.label} {spread(gathered, scene, line, quantity, arrived)}" for line in lines]
    answers = [above(_signed(each, sign)) for each in differences]
    return claim(
        f"{scene.title}: {text}", paper, ", ".join(shown), all_of(answers),
        seeds_of(gathered, scene, lines), BY_EPISODE, decisive,
        tested_all(gathered, scene, lines),
    )  # fmt: skip


def spread(
    gathered: Gathered, scene: Scene, line: Line, quantity: str, arrived: bool = False
) -> str:
    """Mean and standard deviation over the test episodes, as the paper's tables have them."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    values = pooled(outcomes, scene.condition, quantity, arrived)
    return f"{values.mean():.2f}±{values.std():.2f}" if len(values) else "–"


def seeds_of(gathered: Gathered, scene: Scene, lines: Sequence[Line]) -> int:
    """The fewest training seeds of these lines; of the human model there is one, and it counts."""
    counts = [
        len(gathered.tested(scene, line.algorithm, line.setting))
        for line in lines
        if line.algorithm != HUMAN_MODEL
    ]
    return min(counts) if counts else 0


def tested_all(gathered: Gathered, scene: Scene, lines: Sequence[Line]) -> bool:
    """Whether all units of these lines are there, and tested in the scene."""
    tested = all(gathered.tested(scene, line.algorithm, line.setting) for line in lines)
    return tested and complete(gathered, scene.scenario, lines)


def _signed(estimate: Estimate, sign: float) -> Estimate:
    low, high = sorted((sign * estimate.low, sign * estimate.high))
    return Estimate(sign * estimate.value, low, high, estimate.size)
