"""Claims about the tough setting, one frame instead of two: fig. 8."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, permutations, product

import numpy as np

from trainer.experiments.claims.compare import BY_SEED, complete, difference, finals, papers
from trainer.experiments.claims.lines import HI, IA, PER, PHIL
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import SCENARIO_TITLES, TOUGH
from trainer.experiments.progress import DISTANCES, NAMED, TITLES
from trainer.experiments.statistics import Estimate, Holds, above, judge_all, mean_estimate
from trainer.experiments.verdict import Claim, claim

LINES = (PHIL, IA, HI, PER)


def judge_fig8(gathered: Gathered) -> list[Claim]:
    """Who keeps their place, and who loses how much. Of rewards, which may be negative, a ratio
    says nothing.
    """
    places = tuple(product(SCENARIO_TITLES, DISTANCES))
    return [
        *(_ranking_claim(gathered, *place) for place in product(SCENARIO_TITLES, TITLES)),
        *(_cloners_claim(gathered, *place) for place in places),
        *(_others_claim(gathered, *place) for place in places),
    ]


def _cloners_claim(gathered: Gathered, scenario: str, metric: str) -> Claim:
    """Whether each who clones keeps a larger share than each who does not."""
    kept = {line: kept_shares(gathered, scenario, line, metric) for line in LINES}
    differences = {
        f"{one.label} over {two.label}": difference(kept[one], kept[two])
        for one, two in product((PHIL, IA), (HI, PER))
    }
    return _kept_claim(
        gathered, scenario, metric, kept, differences,
        "PHIL-TD3 and IA-TD3 are less affected by the tough setting than HI-TD3 and vanilla TD3",
        "less",
    )  # fmt: skip


def _others_claim(gathered: Gathered, scenario: str, metric: str) -> Claim:
    """Whether each who does not clone loses anything."""
    kept = {line: kept_shares(gathered, scenario, line, metric) for line in (HI, PER)}
    lost = {
        line.label: mean_estimate([1.0 - share for share in shares.values()])
        for line, shares in kept.items()
    }
    text = "HI-TD3 and vanilla TD3 are degraded by the tough setting"
    return _kept_claim(gathered, scenario, metric, kept, lost, text, "significantly")


def _kept_claim(
    gathered: Gathered,
    scenario: str,
    metric: str,
    kept: Mapping[Line, Mapping[int, float]],
    differences: Mapping[str, Estimate],
    text: str,
    paper: str,
) -> Claim:
    judged = judge_all(differences)
    shown = [f"{line.label} {mean_estimate(list(kept[line].values())).text()}" for line in kept]
    return claim(
        f"{SCENARIO_TITLES[scenario]}, {NAMED[metric]}: {text}",
        papers(paper, metric),
        f"tough over normal: {', '.join(shown)}",
        judged.holds,
        judged.size,
        f"ratios of the means, each with its seeds' deviations; {BY_SEED}",
        judged.decisive,
        all(complete(gathered, scenario, [line, _tough(line)]) for line in kept),
        judged.rival,
    )


def kept_shares(gathered: Gathered, scenario: str, line: Line, metric: str) -> dict[int, float]:
    """Seed -> its value of the ratio of the final averages, tough over normal.

    The mean of these values is the ratio of the means, as in the figure; their spread is that
    ratio's to first order. A mean of the seeds' own ratios would be ruled by whichever seed learned
    next to nothing in the normal setting.
    """
    normal = finals(gathered, scenario, line, metric)
    tough = finals(gathered, scenario, _tough(line), metric)
    seeds = sorted(normal.keys() & tough.keys())
    mean = float(np.mean([normal[seed] for seed in seeds])) if seeds else 0.0
    if not mean:
        return {}
    ratio = float(np.mean([tough[seed] for seed in seeds])) / mean
    return {seed: ratio + (tough[seed] - ratio * normal[seed]) / mean for seed in seeds}


def _tough(line: Line) -> Line:
    return Line(line.algorithm, TOUGH)


def _ranking_claim(gathered: Gathered, scenario: str, metric: str) -> Claim:
    """Whether the order of the algorithms is the same in both settings."""
    settings = (list(LINES), [_tough(line) for line in LINES])
    ends = [{line: finals(gathered, scenario, line, metric) for line in own} for own in settings]
    everything = complete(gathered, scenario, [*settings[0], *settings[1]])
    seeds = min(len(end) for own in ends for end in own.values())
    text = (
        f"{SCENARIO_TITLES[scenario]}, {NAMED[metric]}: "
        "the tough setting does not change the ranking"
    )
    paper = papers("same order", metric)
    rule = f"yes: every neighbour ahead in both; no: two swapped for sure; {BY_SEED}"
    if not seeds:
        return claim(text, paper, "", "undecided", 0, rule, None, False)
    orders = [
        sorted(own, key=lambda line: -float(np.mean(list(own[line].values())))) for own in ends
    ]
    shown = [" > ".join(Line(line.algorithm).label for line in order) for order in orders]
    ours = f"normal: {shown[0]}; tough: {shown[1]}"
    return claim(text, paper, ours, _same_order(ends, orders), seeds, rule, None, everything)


def _same_order(
    ends: Sequence[Mapping[Line, Mapping[int, float]]], orders: Sequence[Sequence[Line]]
) -> Holds:
    normal, tough = ends
    swapped = any(
        above(difference(normal[first], normal[second])) == "yes"
        and above(difference(tough[_tough(first)], tough[_tough(second)])) == "no"
        for first, second in permutations(LINES, 2)
    )
    if swapped:
        return "no"
    decided = all(
        above(difference(own[first], own[second])) == "yes"
        for own, order in zip(ends, orders, strict=True)
        for first, second in pairwise(order)
    )
    return "yes" if decided else "undecided"
