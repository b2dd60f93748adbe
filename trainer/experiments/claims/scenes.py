"""Comparisons of test drives that several experiments share.

A claim about an algorithm is one about its training seeds: the mean over a policy's drives is one
number a seed, and intervals are over these. Drives are paired by training and test seed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainer.experiments.claims.compare import BY_SEED, complete, difference
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered, comparable, pairs, pooled
from trainer.experiments.outcome import Drives, Outcome, within_path
from trainer.experiments.plan import Scene
from trainer.experiments.statistics import (
    Estimate,
    Numbers,
    above,
    all_of,
    judge_all,
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

    With ``arrived`` only pairs of drives count in which both reached the goal. Who never arrives
    where we do is left out, and named; that we are ahead of all others cannot be said then. What
    is shown is over all drives, or all that arrived.
    """
    found = {line: _by_seed(gathered, scene, ours, line, quantity, arrived) for line in others}
    differences = {line: mean_estimate([d.mean() for d in found[line] if len(d)]) for line in found}
    left_out = [line for line in others if found[line] and not differences[line].size]
    judged = judge_all([differences[line] for line in others if line not in left_out], sign)
    # Of who is left out nothing is known, which leaves a yes open.
    holds = all_of([judged.holds, *(above(differences[line]) for line in left_out)])
    lines = [ours, *others]
    shown = [f"{line.label} {shown_of(gathered, scene, line, quantity, arrived)}" for line in lines]
    ours_text = ", ".join(shown)
    if arrived and any(found.values()):
        counts = [f"{line.label} {' '.join(str(len(d)) for d in found[line])}" for line in others]
        ours_text += f"; drives in which both arrived, by seed: {', '.join(counts)}"
    if left_out:
        ours_text += f"; left out: {', '.join(line.label for line in left_out)}, no common arrival"
    return claim(
        f"{scene.title}: {text}", paper, ours_text,
        holds, judged.size, _rule(quantity, arrived), judged.decisive,
        tested_all(gathered, scene, lines),
    )  # fmt: skip


def spread_claim(
    gathered: Gathered, scene: Scene, ours: Line, others: Sequence[Line], text: str, paper: str
) -> Claim:
    """Whether one line's surviving distances differ less from drive to drive than all others'."""
    lines = [ours, *others]
    spreads = {
        line: {
            outcome.unit.seed: float(_path_m(scene, outcome.tests[scene.condition]).std())
            for outcome in gathered.tested(scene, line.algorithm, line.setting)
        }
        for line in lines
    }
    judged = judge_all([difference(spreads[ours], spreads[line]) for line in others], sign=-1.0)
    shown = [
        f"{line.label} {mean_estimate(list(of_line.values())).text()} m"
        for line, of_line in spreads.items()
    ]
    return claim(
        f"{scene.title}: {text}", paper, ", ".join(shown),
        judged.holds, judged.size,
        f"standard deviation over each seed's drives; {BY_SEED}; nothing beyond the goal counted",
        judged.decisive,
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


def path_by_seed(gathered: Gathered, scene: Scene, line: Line) -> dict[int, float]:
    """Training seed -> mean surviving distance, m, not counting what is beyond the goal."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    return {o.unit.seed: float(_path_m(scene, o.tests[scene.condition]).mean()) for o in outcomes}


def success_by_seed(gathered: Gathered, scene: Scene, line: Line) -> dict[int, float]:
    """Training seed -> share of its drives that reach the goal."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    return {o.unit.seed: float(o.tests[scene.condition].reached.mean()) for o in outcomes}


def tested_all(gathered: Gathered, scene: Scene, lines: Sequence[Line]) -> bool:
    """Whether all units of these lines are there, and tested in the scene."""
    tested = all(gathered.tested(scene, line.algorithm, line.setting) for line in lines)
    return tested and complete(gathered, scene.scenario, lines)


def _by_seed(
    gathered: Gathered, scene: Scene, first: Line, second: Line, quantity: str, arrived: bool
) -> list[Numbers]:
    """First minus second in each pair of drives: an array for each training seed that both have."""
    own, theirs = (gathered.tested(scene, line.algorithm, line.setting) for line in (first, second))
    differences = []
    for one in own:
        if not any(comparable(one, other) for other in theirs):
            continue
        ours, rivals = pairs([one], theirs, scene.condition, _column(quantity), arrived)
        if quantity == DISTANCE:
            ours, rivals = (within_path(scene.scenario, each) for each in (ours, rivals))
        differences.append(ours - rivals)
    return differences


def _column(quantity: str) -> str:
    return "reached" if quantity == SUCCESS else quantity


def _path_m(scene: Scene, drives: Drives) -> Numbers:
    return within_path(scene.scenario, drives[DISTANCE])


def _rule(quantity: str, arrived: bool) -> str:
    notes = [f"means of the seeds; {BY_SEED}"]
    if quantity == DISTANCE:
        notes.append("nothing beyond the goal counted")
    if arrived:
        notes.append("drives in which both arrived")
    return "; ".join(notes)
