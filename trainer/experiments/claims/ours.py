"""Claims of the experiments that the paper does not have: what it leaves open, and the network."""

from __future__ import annotations

from itertools import product

from trainer.experiments.claims.compare import final_claim
from trainer.experiments.claims.lines import HI, PER, PHIL
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import (
    EXACT_LOSSES,
    IMPORTANCE,
    LAST_ACTOR,
    NETWORK,
    PRINTED_RATES,
    PRINTED_REWARD,
    REMEDY,
    SCENARIO_TITLES,
    WEAK_CLONING,
)
from trainer.experiments.progress import ALONE, TITLES
from trainer.experiments.verdict import Claim

HI_REMEDY, PER_REMEDY = Line("hi_td3", REMEDY), Line("per_td3", REMEDY)
EXACT, WEIGHED = Line("phil_td3", EXACT_LOSSES), Line("phil_td3", IMPORTANCE)
WEAK = Line("phil_td3", WEAK_CLONING)
PRINTED, LAST = Line("phil_td3", PRINTED_RATES), Line("phil_td3", LAST_ACTOR)
LITERAL = Line("phil_td3", PRINTED_REWARD)
BEHIND_NETWORK = Line("phil_td3", NETWORK)


def judge_remedy(gathered: Gathered) -> list[Claim]:
    """Whether the order is one of saturated policies only."""
    claims = []
    for scenario, metric in product(SCENARIO_TITLES, TITLES):
        place = (gathered, scenario, metric)
        claims += [
            final_claim(*place, PHIL, [HI_REMEDY, PER_REMEDY],
                        "PHIL-TD3 ends above HI-TD3 and vanilla TD3 with the remedy", "–"),
            final_claim(*place, HI_REMEDY, [HI], "the remedy helps HI-TD3", "–"),
            final_claim(*place, PER_REMEDY, [PER], "the remedy helps vanilla TD3", "–"),
        ]  # fmt: skip
    return claims


def judge_switches(gathered: Gathered) -> list[Claim]:
    """Whether what the paper leaves open is set for the better here: each policy alone."""
    texts = {
        EXACT: "one mean over the batch ends above eq. 22 and 23 as printed",
        WEIGHED: "no importance weights end above eq. 15",
        WEAK: "cloning with weight 10 ends above weight 1",
        PRINTED: "the faster critic ends above table A5's learning rates",
        LITERAL: "the reward's weight ends above eq. 31 and 32 as printed",
        LAST: "the averaged actor ends above the last one",
    }
    return [
        final_claim(gathered, scenario, ALONE, PHIL, [line], texts[line], "–")
        for scenario, line in product(SCENARIO_TITLES, texts)
    ]


def judge_network(gathered: Gathered) -> list[Claim]:
    """Each policy alone, validated as it was trained: what the network costs.

    What such training is worth, a latency campaign says (``python -m hil_tests campaign``).
    """
    text = "trained and validated without a network ends above trained and validated behind one"
    return [
        final_claim(gathered, scenario, ALONE, PHIL, [BEHIND_NETWORK], text, "–")
        for scenario in SCENARIO_TITLES
    ]
