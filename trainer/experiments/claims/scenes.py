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

    With ``arrived`` only pairs of drives count in which both reached the goal, and are shown; who
    never arrives where we do is left out: that we are ahead of all others cannot be said then.
    """
    found = {line: _by_seed(gathered, scene, ours, line, quantity, arrived) for line in others}
    differences = {
        line.label: mean_estimate([(own - theirs).mean() for own, theirs in drives if len(own)])
        for line, drives in found.items()
    }
    left_out = [one.label for one in others if found[one] and not differences[one.label].size]
    known = {name: each for name, each in differences.items() if name not in left_out}
    judged = judge_all(known, sign)
    # Of who is left out nothing is known, which leaves a yes open.
    holds = all_of([judged.holds, *(above(differences[name]) for name in left_out)])
    lines = [ours, *others]
    if arrived:
        shown = [f"{ours.label} {_where_both_arrived(line, found[line])}" for line in others]
    else:
        shown = [f"{line.label} {shown_of(gathered, scene, line, quantity)}" for line in lines]
    return claim(
        f"{scene.title}: {text}", paper, ", ".join(shown),
        holds, judged.size, _rule(quantity, arrived), judged.decisive,
        tested_all(gathered, scene, lines), judged.rival if len(others) > 1 else "",
    )  # fmt: skip


def _where_both_arrived(line: Line, found: Sequence[tuple[Numbers, Numbers]]) -> str:
    """The means of both over the drives that both finished, and how many of each seed these are."""
    some = [(own.mean(), theirs.mean()) for own, theirs in found if len(own)]
    if not some:
        return f"against {line.label}: {'no common arrival' if found else '–'}"
    own, theirs = np.mean(some, axis=0)
    counts = " ".join(str(len(own)) for own, _ in found)
    return f"{own:.2f} against {line.label} {theirs:.2f} ({counts} drives)"


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
    judged = judge_all(
        {line.label: difference(spreads[ours], spreads[line]) for line in others}, sign=-1.0
    )
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
        judged.rival,
    )  # fmt: skip


def shown_of(gathered: Gathered, scene: Scene, line: Line, quantity: str) -> str:
    """Mean and standard deviation over the test episodes, as the paper's tables have them."""
    outcomes = gathered.tested(scene, line.algorithm, line.setting)
    if quantity == SUCCESS:
        each = [success([outcome], scene.condition).value for outcome in outcomes]
        shares = " ".join(f"{100 * share:.0f}" for share in each)
        return f"{100 * np.mean(each):.1f} % ({shares})" if each else "–"
    values = pooled(outcomes, scene.condition, quantity)
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
) -> list[tuple[Numbers, Numbers]]:
    """First and second in each pair of drives: two arrays for each training seed that both have."""
    own, theirs = (gathered.tested(scene, line.algorithm, line.setting) for line in (first, second))
    paired = []
    for one in own:
        if not any(comparable(one, other) for other in theirs):
            continue
        ours, rivals = pairs([one], theirs, scene.condition, _column(quantity), arrived)
        if quantity == DISTANCE:
            ours, rivals = (within_path(scene.scenario, each) for each in (ours, rivals))
        paired.append((ours, rivals))
    return paired


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
