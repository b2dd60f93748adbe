"""Comparisons of training that several experiments share; all are paired by training seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trainer.experiments.efficiency import efficiency
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import SCENARIO_TITLES
from trainer.experiments.progress import NAMED, VALIDATED, final, progress
from trainer.experiments.statistics import (
    Estimate,
    above,
    judge_all,
    mean_estimate,
    within,
)
from trainer.experiments.verdict import Claim, claim

BY_SEED = "95 % interval of the difference, paired by seed"
BY_BOOTSTRAP = "95 % bootstrap interval over the seeds"
BY_VALUE = "the mean of all seeds itself"
SAME_LEVEL = 0.05
"""Two ends are on one level if they differ by no more than this share."""


def finals(gathered: Gathered, scenario: str, line: Line, metric: str) -> dict[int, float]:
    """Training seed -> final average of a training metric."""
    outcomes = gathered.of(scenario, line.algorithm, line.setting)
    return {outcome.unit.seed: final(outcome, metric) for outcome in outcomes}


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
    sign: float = 1.0,
) -> Claim:
    """Whether one line ends above (sign 1) or below (-1) each of the others."""
    own = finals(gathered, scenario, ours, metric)
    ends = {line: finals(gathered, scenario, line, metric) for line in others}
    judged = judge_all({line.label: difference(own, end) for line, end in ends.items()}, sign)
    shown = [f"{line.label} {mean_estimate(list(end.values())).text()}"
             for line, end in {ours: own, **ends}.items()]  # fmt: skip
    return claim(
        f"{SCENARIO_TITLES[scenario]}, {NAMED[metric]}: {text}",
        papers(paper, metric),
        ", ".join(shown),
        judged.holds,
        judged.size,
        f"final averages; {BY_SEED}",
        judged.decisive,
        complete(gathered, scenario, [ours, *others]),
        judged.rival if len(others) > 1 else "",
    )


def level_claim(
    gathered: Gathered,
    scenario: str,
    metric: str,
    first: Line,
    second: Line,
    text: str,
    paper: str,
) -> Claim:
    """Whether two lines end on the same level."""
    own, other = (finals(gathered, scenario, line, metric) for line in (first, second))
    found = difference(own, other)
    reach = SAME_LEVEL * abs(mean_estimate(list(own.values())).value)
    return claim(
        f"{SCENARIO_TITLES[scenario]}, {NAMED[metric]}: {text}",
        papers(paper, metric),
        f"difference {found.text()}, one level is ±{reach:.2f}" if found.size else "",
        within(found, reach),
        found.size,
        f"within {SAME_LEVEL:.0%} of the end; {BY_SEED}",
        found,
        complete(gathered, scenario, [first, second]),
    )


def papers(paper: str, metric: str) -> str:
    """The paper's number or word: where ours is of the policy alone, the paper's is not."""
    return f"{paper}, in training" if metric in VALIDATED and paper != "–" else paper


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
    own, theirs = (
        progress(gathered.of(scenario, line.algorithm, line.setting), metric)
        for line in (ours, other)
    )
    text = f"{SCENARIO_TITLES[scenario]}, {NAMED[metric]}: {text}"
    paper = papers(paper, metric)
    if own is None or theirs is None:
        return claim(text, paper, "", "undecided", 0, BY_BOOTSTRAP, None, False)
    found = efficiency(own, theirs, common)
    return claim(
        text,
        paper,
        f"{found.ratio.text(1)} times as soon: {ours.label} {_counted(found.episodes)}, "
        f"{other.label} {_counted(found.baseline_episodes)}",
        above(found.ratio, least),
        found.ratio.size,
        f"means of the seeds; {BY_BOOTSTRAP}, with what lies between two measurements",
        found.ratio,
        complete(gathered, scenario, [ours, other, *also]),
    )


def _counted(episodes: float) -> str:
    return "never" if np.isinf(episodes) else f"after {episodes:.0f} episodes"


def best_line(gathered: Gathered, scenario: str, metric: str, lines: Sequence[Line]) -> Line:
    """The line with the highest final average; the first where there is none at all."""
    ends = {line: finals(gathered, scenario, line, metric).values() for line in lines}
    return max(lines, key=lambda line: np.mean(list(ends[line])) if ends[line] else -np.inf)
