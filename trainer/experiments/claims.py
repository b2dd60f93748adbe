"""The paper's claims and this project's bars: its words, its number, how it is judged."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

from trainer.experiments.data import (
    ALONE,
    DISTANCE,
    DROPPED,
    KEPT,
    LATERAL,
    LONGITUDINAL,
    LOST,
    PAPER_SCENES,
    REWARD,
    SECONDS,
    SPREAD,
    SUCCESS,
    TIME_S,
    TRAINING,
    Line,
    Results,
    Scene,
    words,
)
from trainer.experiments.judges import (
    Finding,
    Judge,
    ahead,
    ahead_in,
    changed,
    either,
    level,
    positive,
    same_ranking,
    sooner,
    success_bar,
    unlearned,
)
from trainer.experiments.plan import (
    BIASED,
    CONSTANT,
    FOUR,
    GUIDED,
    HUMAN_MODEL,
    RANDOM,
    SCENARIOS,
)
from trainer.experiments.statistics import above, within

OF_CURVES = ("fig7", "fig8", "fig11", "fig12", "fig13", "ablation")
"""Their claims speak of training curves, in which the human helps: judged of the policy alone,
too."""
NEARLY = 0.02
"""Share of the distance that poor guidance may change where the paper says nearly 50:50."""
LEFT, JAM = SCENARIOS
LEFTS, JAMS = ([s for s in PAPER_SCENES if s.scenario == scenario] for scenario in SCENARIOS)
BOTH = (REWARD, DISTANCE)
PHIL, IA, HI, PER = map(Line, FOUR)
BASELINES = (IA, HI, PER)
HUMAN, FLOOR = Line(HUMAN_MODEL), Line(CONSTANT)
TD, ADVANTAGE = Line("phil_td_only"), Line("phil_q_advantage_only")
SMALL, LARGE = Line("phil_advantage_0.1"), Line("phil_advantage_100")
RD2_PHIL, RD2 = Line("rd2_phil"), Line("rd2_td3")
NO_CLONING, NO_SHAPING = Line("phil_without_cloning"), Line("phil_without_shaping")
POOR_PHIL, POOR_IA, POOR_HI = (Line(name, RANDOM) for name in GUIDED)
BIASED_PHIL, BIASED_IA = (Line(name, BIASED) for name in GUIDED[:2])


class Claim(NamedTuple):
    """A row: a claim of the paper."""

    source: str
    """Experiment, and figure or table of the paper."""
    text: str
    paper: str
    """Its number or word."""
    judge: Judge


CLAIMS: tuple[Claim, ...] = (
    Claim("fig7", "left turn: PHIL-TD3 learns the best asymptotic policy", "best",
          ahead([LEFT], [PHIL], BASELINES, BOTH)),
    Claim("fig7", "left turn: PHIL-TD3, IA-TD3 and HI-TD3 end above vanilla TD3", "higher",
          ahead([LEFT], [PHIL, IA, HI], [PER], BOTH)),
    Claim("fig7", "left turn: they get there in a much shorter time", "much shorter",
          sooner([LEFT], [PHIL, IA, HI], [PER], BOTH)),
    Claim("fig7", "left turn: HI-TD3 is the slowest of the guided", "slowest",
          sooner([LEFT], [PHIL, IA], [HI], BOTH, common=True)),
    Claim("fig7", "left turn: PHIL-TD3 reaches the best baseline's reward seven times as soon",
          "over 700 %", sooner([LEFT], [PHIL], BASELINES, [REWARD], times=7.0, best=True)),
    Claim("fig7", "congestion: PHIL-TD3 and IA-TD3 have comparable rewards", "comparable",
          level([JAM], [PHIL], [IA], [REWARD])),
    Claim("fig7", "congestion: their rewards are above those of HI-TD3 and vanilla TD3", "better",
          ahead([JAM], [PHIL, IA], [HI, PER], [REWARD])),
    Claim("fig7", "congestion: PHIL-TD3 survives furthest", "highest",
          ahead([JAM], [PHIL], BASELINES)),
    Claim("fig7", "congestion: IA-TD3 and HI-TD3 survive comparably far", "comparable",
          level([JAM], [IA], [HI])),
    Claim("fig7", "congestion: IA-TD3 learns faster than HI-TD3", "faster",
          sooner([JAM], [IA], [HI], common=True)),
    Claim("fig7", "congestion: PHIL-TD3 reaches the best baseline's distance 2.2 times as soon",
          "over 120 %", sooner([JAM], [PHIL], BASELINES, times=2.2, best=True)),
    Claim("fig8", "one frame instead of two does not change the ranking", "same",
          same_ranking(SCENARIOS, [PHIL, IA, HI, PER])),
    Claim("fig8", "PHIL-TD3 and IA-TD3 lose less by it than HI-TD3 and vanilla TD3", "less",
          ahead(SCENARIOS, [PHIL, IA], [HI, PER], [KEPT])),
    Claim("fig8", "HI-TD3 and vanilla TD3 lose significantly by it", "significantly",
          positive(SCENARIOS, [HI, PER], LOST)),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three left turns", "highest",
          ahead(LEFTS, [PHIL], BASELINES, [SUCCESS])),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three congestions", "highest",
          ahead(JAMS, [PHIL], BASELINES, [SUCCESS])),
    Claim("fig9", "PHIL-TD3 survives furthest in the three left turns", "furthest",
          ahead(LEFTS, [PHIL], BASELINES)),
    Claim("fig9", "PHIL-TD3 survives furthest in the three congestions",
          "furthest; but in table II's variant IA-TD3 78.39 m, PHIL-TD3 77.29 m",
          ahead(JAMS, [PHIL], BASELINES)),
    Claim("fig9", "PHIL-TD3's distance varies least from drive to drive", "lowest variance",
          ahead(PAPER_SCENES, [PHIL], BASELINES, [SPREAD], sign=-1.0)),
    Claim("fig9", "vanilla TD3 is competitive with IA-TD3 and HI-TD3 in success", "competitive",
          level(PAPER_SCENES, [PER], [IA, HI], [SUCCESS])),
    Claim("fig9", "the variant scenes significantly degrade the three baselines", "significantly",
          positive(SCENARIOS, BASELINES, DROPPED)),
    Claim("fig10", "left turn: PHIL-TD3 takes the least time", "least",
          ahead(LEFTS, [PHIL], BASELINES, [TIME_S], sign=-1.0)),
    Claim("fig10", "congestion, nominal and noise: the guided are smoother than vanilla TD3",
          "smoother", ahead(JAMS[:2], [PHIL, IA, HI], [PER], [LATERAL], sign=-1.0)),
    Claim("fig10", "congestion, variant: PHIL-TD3 is the smoothest", "smoothest",
          ahead(JAMS[2:], [PHIL], BASELINES, [LATERAL], sign=-1.0)),
    Claim("table1", "left turn: PHIL-TD3 survives further than the human model",
          "21.28 to 20.70, 21.27 to 20.88, 21.29 to 20.90 m", ahead(LEFTS, [PHIL], [HUMAN])),
    Claim("table2", "congestion: PHIL-TD3 survives further than the human model",
          "80.15 to 80.11, 79.26 to 77.66, 77.29 to 75.15 m", ahead(JAMS, [PHIL], [HUMAN])),
    Claim("fig11", "TD error alone learns faster than the Q advantage alone", "faster",
          sooner(SCENARIOS, [TD], [ADVANTAGE], BOTH, common=True)),
    Claim("fig11", "the Q advantage alone ends significantly above TD error alone", "above",
          ahead(SCENARIOS, [ADVANTAGE], [TD], BOTH)),
    Claim("fig11", "both together (PHIL-TD3) end highest", "most favourable",
          ahead(SCENARIOS, [PHIL], [TD, ADVANTAGE], BOTH)),
    Claim("fig12", "weight 0.1 on the Q advantage converges faster than 1", "faster",
          sooner(SCENARIOS, [SMALL], [PHIL], BOTH, common=True)),
    Claim("fig12", "weight 0.1 ends below 1", "below", ahead(SCENARIOS, [PHIL], [SMALL], BOTH)),
    Claim("fig12", "weight 100 ends on the level of 1", "same level",
          level(SCENARIOS, [PHIL], [LARGE], BOTH)),
    Claim("fig13", "one buffer (PHIL-TD3) learns faster than two (RD2-PHIL)", "faster",
          sooner(SCENARIOS, [PHIL], [RD2_PHIL], BOTH, common=True)),
    Claim("fig13", "RD2-TD3, without TDQA, ends lowest", "least favourable",
          ahead(SCENARIOS, [RD2], [PHIL, RD2_PHIL], BOTH, sign=-1.0)),
    Claim("ablation", "behaviour cloning is effective", "effective",
          ahead(SCENARIOS, [PHIL], [NO_CLONING], BOTH)),
    Claim("ablation", "the priority of human demonstrations is effective", "effective",
          ahead(SCENARIOS, [PHIL], [IA], BOTH)),
    Claim("ablation", "intervention-based shaping is effective", "effective",
          ahead(SCENARIOS, [PHIL], [NO_SHAPING], BOTH)),
    Claim("fig14", "poor guidance hardly changes PHIL-TD3's distance in any of six scenes",
          "nearly 50:50", changed(PHIL, partial(within, reach=NEARLY),
                                  groups=[(scene,) for scene in PAPER_SCENES])),
    Claim("fig14", "poor guidance degrades IA-TD3", "-2.1 %",
          changed(IA, lambda one: above(one.times(-1.0)))),
    Claim("fig14", "poor guidance does not degrade HI-TD3", "+3.6 %",
          changed(HI, partial(above, least=-NEARLY))),
    Claim("fig14", "PHIL-TD3 is more robust to poor guidance than IA-TD3", "more",
          changed(PHIL, above, than=IA)),
    Claim("fig15", "left turn: PHIL-TD3 is the smoothest after poor guidance", "smoothest",
          ahead(LEFTS, [POOR_PHIL], [POOR_IA, POOR_HI], [LONGITUDINAL], sign=-1.0)),
    Claim("fig15", "congestion: PHIL-TD3 is the smoothest after poor guidance", "smoothest",
          ahead(JAMS, [POOR_PHIL], [POOR_IA, POOR_HI], [LATERAL], sign=-1.0)),
    Claim("time", "PHIL-TD3 and IA-TD3 take a similar time to train", "similar, 1.03 times",
          level([LEFT], [PHIL], [IA], [SECONDS])),
)  # fmt: skip
"""All that the paper says of its results."""


BARS: tuple[tuple[str, Judge], ...] = (
    *(
        (f"{line.name}, {words(place)}: success at least 85 %",
         success_bar(Scene(place, "nominal"), line, 0.85))
        for line, place in product((PER, HI), SCENARIOS)
    ),
    *(
        (f"{line.name}, {words(place)}: above the best constant action",
         ahead([Scene(place, "nominal")], [line], [FLOOR], [SUCCESS]))
        for line, place in product((PER, HI), SCENARIOS)
    ),
    *(
        (f"PHIL-TD3, {scene.label}: success at least {100 * least:.0f} %",
         success_bar(scene, PHIL, least))
        for scene, least in zip(PAPER_SCENES, (0.99, 0.98, 0.96) * 2, strict=True)
    ),
    ("PHIL-TD3 ahead of its human in success or distance in at least four of six scenes",
     ahead_in(PHIL, HUMAN, 4)),
    *(
        (f"{words(place)}: PHIL-TD3 alone at 90 % {how_soon}",
         sooner([place], [PHIL], [other], [SUCCESS], times, least=0.9, by_mean=True))
        for place in SCENARIOS
        for how_soon, other, times in (
            ("in at most a third of vanilla TD3's steps", PER, 3.0),
            ("in no more steps than IA-TD3", IA, 1.0),
        )
    ),
    ("with biased guidance PHIL-TD3 ends ahead of IA-TD3 in at least one scenario",
     either(*(ahead([place], [BIASED_PHIL], [BIASED_IA], [SUCCESS]) for place in SCENARIOS))),
    *(
        (f"PHIL-TD3, {words(place)}: ends at most 2 points below its best", unlearned(place, PHIL))
        for place in SCENARIOS
    ),
)  # fmt: skip
"""What this project asks of itself: words, and how they are judged. Of the policy alone."""


class Judged(NamedTuple):
    """A claim with what was measured."""

    claim: Claim
    found: Finding
    alone: Finding | None
    """The same of the policy alone, where the claim is about training curves."""


def judge(results: Results) -> Iterator[Judged]:
    """Every claim of the paper."""
    for claim in CLAIMS:
        alone = claim.judge(results, ALONE) if claim.source in OF_CURVES else None
        yield Judged(claim, claim.judge(results, TRAINING), alone)


def judge_bars(results: Results) -> Iterator[tuple[str, Finding]]:
    """Every bar."""
    for text, bar in BARS:
        yield text, bar(results, ALONE)
