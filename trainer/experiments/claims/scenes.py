"""Comparisons of test drives that several experiments share.

A claim about an algorithm is one about its training seeds: the mean over a policy's drives is one
number a seed, and intervals are over these. Drives are paired by training and test seed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainer.experiments.claims.compare import BY_SEED, complete
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered, pairs, pooled
from trainer.experiments.outcome import Drives, Outcome, within_path
from trainer.experiments.plan import HUMAN_MODEL, Scene
from trainer.experiments.statistics import (
    Estimate,
    Numbers,
    above,
    all_of,
    mean_estimate,
    success_estimate,
)
from trainer.experiments.verdict import Claim, claim

DISTANCE = "distance_m"
SUCCESS = "success"
"""Stands in a quantity's place for the share of the drives that reach the goal."""


def success(outcomes: Sequence[Outcome], condition: str) -> Estimate:
    """Success over all test episodes of some outcomes."""
    reached = [outcome.tests[condition].reached for outcome in outcomes]
    return success_estimate(int(sum(map(np.sum, reached))), sum(map(len, reached)))


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
    """Whether one line's mean over test episodes is above (sign 1) or below (-1) all others'.

    With ``arrived`` only pairs of drives count in which both reached the goal; who never arrives
    where we do is left out, and named. What is shown is over all drives, or all that arrived.
    """
    lines = [ours, *others]
    found = {line: _by_seed(gathered, scene, ours, line, quantity, arrived) for line in others}
    left_out = [
        line
        for line in others
        if arrived and not found[line] and gathered.tested(scene, line.algorithm, line.setting)
    ]
    differences = [mean_estimate(found[line]) for line in others if line not in left_out]
    signed = [difference.times(sign) for difference in differences]
    decisive = min(signed, key=lambda each: each.low, default=None)
    shown = [f"{line.label} {shown_of(gathered, scene, line, quantity, arrived)}" for line in lines]
    ours_text = ", ".join(shown)
    if left_out:
        ours_text += f"; left out: {', '.join(line.label for line in left_out)}, no common arrival"
    return claim(
        f"{scene.title}: {text}", paper, ours_text,
        all_of([above(each) for each in signed]),
        seeds_of(gathered, scene, lines), _rule(quantity, arrived),
        decisive.times(sign) if decisive else None,
        tested_all(gathered, scene, lines),
    )  # fmt: skip


def shown_of(
    gathered: Gathered, scene: Scene, line: Line, quantity: str, arrived: bool = False
) -> str:
    """Mean and standard deviation over the test episodes, as the paper's tables have them."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    if quantity == SUCCESS:
        each = [success([outcome], scene.condition).value for outcome in outcomes]
        shares = " ".join(f"{100 * share:.0f}" for share in each)
        return f"{100 * np.mean(each):.1f} % ({shares})" if each else "–"
    values = pooled(outcomes, scene.condition, quantity, arrived)
    return f"{values.mean():.2f}±{values.std():.2f}" if len(values) else "–"


def path_by_seed(gathered: Gathered, scene: Scene, line: Line) -> Numbers:
    """Mean surviving distance of each seed, not counting what is beyond the goal."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    return np.array([_mean(scene, outcome.tests[scene.condition]) for outcome in outcomes])


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


def _by_seed(
    gathered: Gathered, scene: Scene, first: Line, second: Line, quantity: str, arrived: bool
) -> list[float]:
    """Mean of first minus second for each training seed that has a pair of drives."""
    own, theirs = (gathered.tested(scene, line.algorithm, line.setting) for line in (first, second))
    means = []
    for one in own:
        values, others = pairs([one], theirs, scene.condition, _column(quantity), arrived)
        if not len(values):
            continue
        if quantity == DISTANCE:
            values, others = (within_path(scene.scenario, each) for each in (values, others))
        means.append(float((values - others).mean()))
    return means


def _column(quantity: str) -> str:
    return "reached" if quantity == SUCCESS else quantity


def _mean(scene: Scene, drives: Drives) -> float:
    return float(within_path(scene.scenario, drives[DISTANCE]).mean())


def _rule(quantity: str, arrived: bool) -> str:
    notes = [f"means of the seeds; {BY_SEED}"]
    if quantity == DISTANCE:
        notes.append("nothing beyond the goal counted")
    if arrived:
        notes.append("drives in which both arrived")
    return "; ".join(notes)
