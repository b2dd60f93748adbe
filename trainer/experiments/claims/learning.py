"""Claims about training: figs. 7, 11 to 13 and the ablation."""

from __future__ import annotations

from itertools import product

from trainer.experiments.claims.compare import best_line, final_claim, level_claim, speed_claim
from trainer.experiments.claims.lines import (
    HI,
    IA,
    LARGE,
    NO_CLONING,
    NO_SHAPING,
    NO_TDQA,
    PER,
    PHIL,
    Q_ADVANTAGE,
    RD2,
    RD2_PHIL,
    SMALL,
    TD,
    TDQA,
)
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import SCENARIO_TITLES
from trainer.experiments.progress import ALONE, DISTANCE_ALONE, TITLES
from trainer.experiments.verdict import Claim

SPEEDS = {
    ("left_turn", "episode_return"): 7.0, ("left_turn", ALONE): 7.0,
    ("congestion", "distance_m"): 2.2, ("congestion", ALONE): 2.2,
}  # fmt: skip
"""The paper's learning efficiency, of the curve that it names, and what is asked of the policy
alone: "by over 700 %" is seven times, as its introduction has it, "by over 120 %" 2.2 times."""

EVERYWHERE = tuple(product(SCENARIO_TITLES, TITLES))
"""The paper's curves are of episodes in which the human takes over, which flatters whoever is
guided: each claim is held against the policy alone, too."""


def judge_fig7(gathered: Gathered) -> list[Claim]:
    """Asymptotic performance and learning efficiency."""
    return [*_left_turn(gathered), *_congestion(gathered), *_efficiency(gathered)]


def _left_turn(gathered: Gathered) -> list[Claim]:
    claims = []
    for metric in TITLES:
        place = (gathered, "left_turn", metric)
        claims += [
            final_claim(*place, PHIL, [IA, HI, PER], "PHIL-TD3 learns the best asymptotic policy"),
            *(
                final_claim(*place, line, [PER],
                            f"{line.label}, guided by the human, ends above vanilla TD3", "above")
                for line in (IA, HI)
            ),
            *(
                speed_claim(*place, line, HI, "HI-TD3 learns most slowly of those who are guided: "
                            f"{line.label} is sooner on their common level", "sooner", common=True)
                for line in (PHIL, IA)
            ),
        ]  # fmt: skip
    return claims


def _congestion(gathered: Gathered) -> list[Claim]:
    place = (gathered, "congestion", "episode_return")
    claims = [
        level_claim(*place, PHIL, IA, "PHIL-TD3 and IA-TD3 end on one level", "comparable"),
        *(
            final_claim(*place, line, [HI, PER], f"{line.label} ends above HI-TD3 and vanilla TD3",
                        "above")
            for line in (PHIL, IA)
        ),
    ]  # fmt: skip
    for metric, driven in (("distance_m", "distance_m"), (ALONE, DISTANCE_ALONE)):
        place = (gathered, "congestion", metric)
        claims += [
            final_claim(*place, PHIL, [IA, HI, PER], "PHIL-TD3 learns the best asymptotic policy"),
            final_claim(*place, IA, [PER], "IA-TD3, guided by the human, ends above vanilla TD3",
                        "above"),
            level_claim(*place, IA, HI, "IA-TD3 and HI-TD3 end on one level", "comparable"),
            speed_claim(gathered, "congestion", driven, IA, HI,
                        "IA-TD3 learns faster than HI-TD3, to their common level",
                        "sooner", common=True),
        ]  # fmt: skip
    return claims


def _efficiency(gathered: Gathered) -> list[Claim]:
    claims, baselines = [], [IA, HI, PER]
    text = "PHIL-TD3 reaches the best baseline's final average sooner"
    for (scenario, metric), least in SPEEDS.items():
        place = (gathered, scenario, metric)
        best = best_line(*place, baselines)
        paper = f"over {least:g} times"
        claims.append(speed_claim(*place, PHIL, best, text, paper, least, also=baselines))
    return claims


def judge_fig11(gathered: Gathered) -> list[Claim]:
    """TD against Q-advantage as the priority."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, TD, Q_ADVANTAGE, "TD learns faster than Q-advantage", "faster",
                        common=True),
            final_claim(*place, Q_ADVANTAGE, [TD], "Q-advantage ends above TD", "above"),
            final_claim(*place, TDQA, [TD, Q_ADVANTAGE], "TDQA, which has both, ends highest"),
        ]  # fmt: skip
    return claims


def judge_fig12(gathered: Gathered) -> list[Claim]:
    """The weight of the Q-advantage."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, SMALL, TDQA, "w = 0.1 converges faster than w = 1", "faster",
                        common=True),
            final_claim(*place, TDQA, [SMALL], "w = 0.1 ends below w = 1", "below"),
            level_claim(*place, TDQA, LARGE, "w = 100 ends on the level of w = 1",
                        "same level"),
        ]  # fmt: skip
    return claims


def judge_fig13(gathered: Gathered) -> list[Claim]:
    """One buffer against two."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            speed_claim(*place, PHIL, RD2_PHIL, "one buffer (PHIL-TD3) learns faster than two "
                        "(RD2-PHIL)", "faster", common=True),
            final_claim(*place, RD2, [PHIL, RD2_PHIL],
                        "RD2-TD3, without TDQA, is the least favourable", "lowest", -1.0),
        ]  # fmt: skip
    return claims


def judge_ablation(gathered: Gathered) -> list[Claim]:
    """PHIL-TD3 without each of its parts."""
    claims = []
    for scenario, metric in EVERYWHERE:
        place = (gathered, scenario, metric)
        claims += [
            final_claim(*place, PHIL, [without], f"{part} is effective", "effective")
            for without, part in (
                (NO_CLONING, "behaviour cloning"),
                (NO_TDQA, "the priority mechanism"),
                (NO_SHAPING, "the intervention-based shaping"),
            )
        ]
    return claims
