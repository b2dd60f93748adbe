"""Claims about training: figs. 7, 8, 11 to 13 and the ablation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, permutations, product

import numpy as np

from trainer.experiments.claims.compare import (
    BY_SEED,
    best_line,
    complete,
    difference,
    final_claim,
    finals,
    speed_claim,
)
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import SCENARIO_TITLES, TOUGH
from trainer.experiments.progress import ALONE, DISTANCES, TITLES
from trainer.experiments.statistics import Holds, above, mean_estimate
from trainer.experiments.verdict import Claim, claim

PHIL, IA, HI, PER = map(Line, ("phil_td3", "ia_td3", "hi_td3", "per_td3"))
TD, Q_ADVANTAGE = Line("phil_td_only"), Line("phil_q_advantage_only")
SMALL, LARGE = Line("phil_advantage_0.1"), Line("phil_advantage_100")
RD2, RD2_PHIL = Line("rd2_td3"), Line("rd2_phil")
NO_CLONING, NO_SHAPING = map(Line, ("phil_without_cloning", "phil_without_shaping"))
NO_TDQA = IA
"""IA-TD3 is PHIL-TD3 without TDQA: the same switches."""

SPEEDS = {
    ("left_turn", "episode_return"): 7.0, ("left_turn", ALONE): 7.0,
    ("congestion", "distance_m"): 2.2, ("congestion", ALONE): 2.2,
}  # fmt: skip
"""The paper's learning efficiency, where it gives one, and what is asked of the policy alone."""
SAME_LEVEL = 0.05
"""Two ends are on one level if they differ by no more than this share."""

EVERYWHERE = tuple(product(SCENARIO_TITLES, TITLES))
"""The paper's curves are of episodes in which the human takes over, which flatters whoever is
guided: each claim is held against the policy alone, too."""


def judge_fig7(gathered: Gathered) -> list[Claim]:
    """Asymptotic performance and learning efficiency."""
    claims = []
    baselines = [IA, HI, PER]
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        text = "PHIL-TD3 learns the best asymptotic policy"
        claims.append(final_claim(*place, PHIL, baselines, text))
        least = SPEEDS.get((scenario, metric))
        paper = "sooner" if least is None else f"over {least:g} times"
        text = "PHIL-TD3 reaches the best baseline's final average sooner"
        best = best_line(*place, baselines)
        claims.append(speed_claim(*place, PHIL, best, text, paper, least or 1.0, also=baselines))
    for scenario, metric, line in product(SCENARIO_TITLES, DISTANCES, (IA, HI)):
        text = f"{line.label}, guided by the human, ends above vanilla TD3"
        claims.append(final_claim(gathered, scenario, metric, line, [PER], text, "above"))
    return claims


def judge_fig8(gathered: Gathered) -> list[Claim]:
    """What one frame instead of two changes."""
    claims = []
    lines = [PHIL, IA, HI, PER]
    for scenario, metric in EVERYWHERE:
        claims.append(_ranking_claim(gathered, scenario, metric, lines))
    for scenario, metric in product(SCENARIO_TITLES, DISTANCES):
        kept = {line: _kept_shares(gathered, scenario, line, metric) for line in lines}
        seeds = sorted(set.intersection(*(set(shares) for shares in kept.values())))
        gaps = [
            0.5 * (kept[PHIL][s] + kept[IA][s]) - 0.5 * (kept[HI][s] + kept[PER][s]) for s in seeds
        ]
        found = mean_estimate(gaps)
        shown = [
            f"{line.label} {mean_estimate(list(kept[line].values())).text()}" for line in lines
        ]
        claims.append(
            claim(
                f"{SCENARIO_TITLES[scenario]}, {TITLES[metric]}: PHIL-TD3 and IA-TD3 are less "
                "affected by the tough setting than HI-TD3 and vanilla TD3",
                "less",
                f"tough over normal: {', '.join(shown)}",
                above(found),
                found.size,
                BY_SEED,
                found,
                all(complete(gathered, scenario, [line, _tough(line)]) for line in lines),
            )
        )
    return claims


def _tough(line: Line) -> Line:
    return Line(line.algorithm, TOUGH)


def _kept_shares(gathered: Gathered, scenario: str, line: Line, metric: str) -> dict[int, float]:
    """Seed -> final value in the tough setting over that in the normal one."""
    normal = finals(gathered, scenario, line, metric)
    tough = finals(gathered, scenario, _tough(line), metric)
    return {seed: tough[seed] / normal[seed] for seed in tough if normal.get(seed)}


def _ranking_claim(gathered: Gathered, scenario: str, metric: str, lines: Sequence[Line]) -> Claim:
    """Whether the order of the algorithms is the same in both settings."""
    settings = (list(lines), [_tough(line) for line in lines])
    ends = [{line: finals(gathered, scenario, line, metric) for line in own} for own in settings]
    everything = complete(gathered, scenario, [*settings[0], *settings[1]])
    seeds = min(len(end) for own in ends for end in own.values())
    text = (
        f"{SCENARIO_TITLES[scenario]}, {TITLES[metric]}: "
        "the tough setting does not change the ranking"
    )
    rule = f"yes: every neighbour ahead in both; no: two swapped for sure; {BY_SEED}"
    if not seeds:
        return claim(text, "same order", "", "undecided", 0, rule, None, False)
    orders = [
        sorted(own, key=lambda line: -float(np.mean(list(own[line].values())))) for own in ends
    ]
    names = [[line.algorithm for line in order] for order in orders]
    shown = [" > ".join(Line(name).label for name in order) for order in names]
    normal, tough = ends
    swapped = any(
        above(difference(normal[first], normal[second])) == "yes"
        and above(difference(tough[_tough(first)], tough[_tough(second)])) == "no"
        for first, second in permutations(lines, 2)
    )
    decided = all(
        above(difference(own[first], own[second])) == "yes"
        for own, order in zip(ends, orders, strict=True)
        for first, second in pairwise(order)
    )
    holds: Holds = "no" if swapped else "yes" if decided else "undecided"
    ours = f"normal: {shown[0]}; tough: {shown[1]}"
    return claim(text, "same order", ours, holds, seeds, rule, None, everything)


def judge_fig11(gathered: Gathered) -> list[Claim]:
    """TD against Q-advantage as the priority."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, TD, Q_ADVANTAGE, "TD learns faster than Q-advantage", "faster",
                        common=True),
            final_claim(*place, Q_ADVANTAGE, [TD], "Q-advantage ends above TD", "above"),
            final_claim(*place, PHIL, [TD, Q_ADVANTAGE], "TDQA, which has both, ends highest"),
        ]  # fmt: skip
    return claims


def judge_fig12(gathered: Gathered) -> list[Claim]:
    """The weight of the Q-advantage."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, SMALL, PHIL, "w = 0.1 converges faster than w = 1", "faster",
                        common=True),
            final_claim(*place, PHIL, [SMALL], "w = 0.1 ends below w = 1", "below"),
            _level_claim(*place, PHIL, LARGE, "w = 100 ends on the level of w = 1"),
        ]  # fmt: skip
    return claims


def _level_claim(
    gathered: Gathered, scenario: str, metric: str, first: Line, second: Line, text: str
) -> Claim:
    own, other = (finals(gathered, scenario, line, metric) for line in (first, second))
    found = difference(own, other)
    reach = SAME_LEVEL * abs(mean_estimate(list(own.values())).value)
    holds: Holds = "undecided"
    if -reach <= found.low and found.high <= reach:
        holds = "yes"
    elif found.low > reach or found.high < -reach:
        holds = "no"
    return claim(
        f"{SCENARIO_TITLES[scenario]}, {TITLES[metric]}: {text}",
        "same level",
        f"difference {found.text()}, one level is ±{reach:.2f}" if found.size else "",
        holds,
        found.size,
        f"within {SAME_LEVEL:.0%} of the end; {BY_SEED}",
        found,
        complete(gathered, scenario, [first, second]),
    )


def judge_fig13(gathered: Gathered) -> list[Claim]:
    """One buffer against two."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, PHIL, RD2_PHIL, "one buffer (PHIL-TD3) learns faster than two "
                        "(RD2-PHIL)", "faster", common=True),
            final_claim(*place, RD2_PHIL, [RD2], "RD2-TD3, without TDQA, is the least favourable",
                        "below RD2-PHIL"),
        ]  # fmt: skip
    return claims


def judge_ablation(gathered: Gathered) -> list[Claim]:
    """PHIL-TD3 without each of its parts."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            final_claim(*place, PHIL, [without], f"{part} is effective", "ends above the ablation")
            for without, part in (
                (NO_CLONING, "behaviour cloning"),
                (NO_TDQA, "the priority mechanism"),
                (NO_SHAPING, "the intervention-based shaping"),
            )
        ]
    for scenario, metric, other in product(SCENARIO_TITLES, DISTANCES, (NO_CLONING, NO_SHAPING)):
        text = f"the priority mechanism matters most: more is kept {other.label}"
        paper = "above the one without TDQA"
        claims.append(final_claim(gathered, scenario, metric, other, [NO_TDQA], text, paper))
    return claims
