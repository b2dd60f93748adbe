"""The paper's claims and this project's bars: its words, its number, how it is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

from trainer.experiments.data import (
    ALONE,
    DISTANCE,
    HUMAN,
    LATERAL,
    LONGITUDINAL,
    PAPER_SCENES,
    REWARD,
    SPREAD,
    SUCCESS,
    TIME_S,
    TRAINING,
    Line,
    Results,
    Scene,
)
from trainer.experiments.judges import (
    HI,
    IA,
    PER,
    PHIL,
    Finding,
    Judge,
    Place,
    above,
    ahead,
    ahead_in,
    changed,
    dropped,
    either,
    kept,
    level,
    lost,
    name_of,
    same_ranking,
    sooner,
    success_bar,
    unlearned,
)
from trainer.experiments.plan import BIASED, CONSTANT, RANDOM, SCENARIOS
from trainer.experiments.statistics import within

NEARLY = 0.02
"""Share of the distance that poor guidance may change where the paper says nearly 50:50."""
LEFT, JAM = SCENARIOS
FLOOR = Line(CONSTANT)
TD, ADVANTAGE = Line("phil_td_only"), Line("phil_q_advantage_only")
SMALL, LARGE = Line("phil_advantage_0.1"), Line("phil_advantage_100")
RD2_PHIL, RD2 = Line("rd2_phil"), Line("rd2_td3")


class Claim(NamedTuple):
    """A row: a claim of the paper."""

    source: str
    """Experiment, and figure or table of the paper."""
    text: str
    paper: str
    """Its number or word."""
    judge: Judge
    curves: bool = False
    """Whether it speaks of training curves, in which the human helps: judged of the policy alone,
    too."""


def of(
    judge: Callable[..., Finding],
    places: Sequence[Place],
    ours: Sequence[Line],
    others: Sequence[Line] = (),
    **more: object,
) -> Judge:
    """A judge of these lines in these places."""
    lines = {"ours": ours, "others": others} if others else {"ours": ours}
    return partial(judge, places=places, **lines, **more)


def _scenes(scenario: str, *conditions: str) -> list[Scene]:
    """The paper's three scenes of a scenario, or some of them."""
    scenes = [scene for scene in PAPER_SCENES if scene.scenario == scenario]
    return [scene for scene in scenes if not conditions or scene.condition in conditions]


BOTH, CURVES = (REWARD, DISTANCE), True
BASELINES = (IA, HI, PER)
POOR_PHIL, POOR_IA, POOR_HI = (Line(line.algorithm, RANDOM) for line in (PHIL, IA, HI))
BIASED_PHIL, BIASED_IA = (Line(line.algorithm, BIASED) for line in (PHIL, IA))
CLAIMS: tuple[Claim, ...] = (
    Claim("fig7", "left turn: PHIL-TD3 learns the best asymptotic policy", "best",
          of(ahead, [LEFT], [PHIL], BASELINES, quantities=BOTH), CURVES),
    Claim("fig7", "left turn: PHIL-TD3, IA-TD3 and HI-TD3 end above vanilla TD3", "higher",
          of(ahead, [LEFT], [PHIL, IA, HI], [PER], quantities=BOTH), CURVES),
    Claim("fig7", "left turn: they get there in a much shorter time", "much shorter",
          of(sooner, [LEFT], [PHIL, IA, HI], [PER], quantities=BOTH), CURVES),
    Claim("fig7", "left turn: HI-TD3 is the slowest of the guided", "slowest",
          of(sooner, [LEFT], [PHIL, IA], [HI], quantities=BOTH, common=True),
          CURVES),
    Claim("fig7", "left turn: PHIL-TD3 reaches the best baseline's reward seven times as soon",
          "over 700 %",
          of(sooner, [LEFT], [PHIL], BASELINES, quantities=[REWARD],
               times=7.0, best=True), CURVES),
    Claim("fig7", "congestion: PHIL-TD3 and IA-TD3 have comparable rewards", "comparable",
          of(level, [JAM], [PHIL], [IA], quantities=[REWARD]), CURVES),
    Claim("fig7", "congestion: their rewards are above those of HI-TD3 and vanilla TD3", "better",
          of(ahead, [JAM], [PHIL, IA], [HI, PER], quantities=[REWARD]),
          CURVES),
    Claim("fig7", "congestion: PHIL-TD3 survives furthest", "highest",
          of(ahead, [JAM], [PHIL], BASELINES), CURVES),
    Claim("fig7", "congestion: IA-TD3 and HI-TD3 survive comparably far", "comparable",
          of(level, [JAM], [IA], [HI]), CURVES),
    Claim("fig7", "congestion: IA-TD3 learns faster than HI-TD3", "faster",
          of(sooner, [JAM], [IA], [HI], common=True), CURVES),
    Claim("fig7", "congestion: PHIL-TD3 reaches the best baseline's distance 2.2 times as soon",
          "over 120 %",
          of(sooner, [JAM], [PHIL], BASELINES, times=2.2, best=True), CURVES),
    Claim("fig8", "one frame instead of two does not change the ranking", "same",
          partial(same_ranking, places=SCENARIOS, lines=[PHIL, IA, HI, PER]), CURVES),
    Claim("fig8", "PHIL-TD3 and IA-TD3 lose less by it than HI-TD3 and vanilla TD3", "less",
          of(kept, SCENARIOS, [PHIL, IA], [HI, PER]), CURVES),
    Claim("fig8", "HI-TD3 and vanilla TD3 lose significantly by it", "significantly",
          of(lost, SCENARIOS, [HI, PER]), CURVES),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three left turns", "highest",
          of(ahead, _scenes(LEFT), [PHIL], BASELINES, quantities=[SUCCESS])),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three congestions", "highest",
          of(ahead, _scenes(JAM), [PHIL], BASELINES, quantities=[SUCCESS])),
    Claim("fig9", "PHIL-TD3 survives furthest in the three left turns", "furthest",
          of(ahead, _scenes(LEFT), [PHIL], BASELINES)),
    Claim("fig9", "PHIL-TD3 survives furthest in the three congestions",
          "furthest; but in table II's variant IA-TD3 78.39 m, PHIL-TD3 77.29 m",
          of(ahead, _scenes(JAM), [PHIL], BASELINES)),
    Claim("fig9", "PHIL-TD3's distance varies least from drive to drive", "lowest variance",
          of(ahead, PAPER_SCENES, [PHIL], BASELINES, quantities=[SPREAD],
               sign=-1.0)),
    Claim("fig9", "vanilla TD3 is competitive with IA-TD3 and HI-TD3 in success", "competitive",
          of(level, PAPER_SCENES, [PER], [IA, HI], quantities=[SUCCESS])),
    Claim("fig9", "the variant scenes significantly degrade the three baselines", "significantly",
          of(dropped, SCENARIOS, BASELINES)),
    Claim("fig10", "left turn: PHIL-TD3 takes the least time", "least",
          of(ahead, _scenes(LEFT), [PHIL], BASELINES, quantities=[TIME_S],
               sign=-1.0)),
    Claim("fig10", "congestion, nominal and noise: the guided are smoother than vanilla TD3",
          "smoother",
          of(ahead, _scenes(JAM, "nominal", "noise"), [PHIL, IA, HI], [PER],
               quantities=[LATERAL], sign=-1.0)),
    Claim("fig10", "congestion, variant: PHIL-TD3 is the smoothest", "smoothest",
          of(ahead, _scenes(JAM, "variant"), [PHIL], BASELINES,
               quantities=[LATERAL], sign=-1.0)),
    Claim("table1", "left turn: PHIL-TD3 survives further than the human model",
          "21.28 to 20.70, 21.27 to 20.88, 21.29 to 20.90 m",
          of(ahead, _scenes(LEFT), [PHIL], [HUMAN])),
    Claim("table2", "congestion: PHIL-TD3 survives further than the human model",
          "80.15 to 80.11, 79.26 to 77.66, 77.29 to 75.15 m",
          of(ahead, _scenes(JAM), [PHIL], [HUMAN])),
    Claim("fig11", "TD error alone learns faster than the Q advantage alone", "faster",
          of(sooner, SCENARIOS, [TD], [ADVANTAGE], quantities=BOTH,
               common=True), CURVES),
    Claim("fig11", "the Q advantage alone ends significantly above TD error alone", "above",
          of(ahead, SCENARIOS, [ADVANTAGE], [TD], quantities=BOTH), CURVES),
    Claim("fig11", "both together (PHIL-TD3) end highest", "most favourable",
          of(ahead, SCENARIOS, [PHIL], [TD, ADVANTAGE], quantities=BOTH),
          CURVES),
    Claim("fig12", "weight 0.1 on the Q advantage converges faster than 1", "faster",
          of(sooner, SCENARIOS, [SMALL], [PHIL], quantities=BOTH,
               common=True), CURVES),
    Claim("fig12", "weight 0.1 ends below 1", "below",
          of(ahead, SCENARIOS, [PHIL], [SMALL], quantities=BOTH), CURVES),
    Claim("fig12", "weight 100 ends on the level of 1", "same level",
          of(level, SCENARIOS, [PHIL], [LARGE], quantities=BOTH), CURVES),
    Claim("fig13", "one buffer (PHIL-TD3) learns faster than two (RD2-PHIL)", "faster",
          of(sooner, SCENARIOS, [PHIL], [RD2_PHIL], quantities=BOTH,
               common=True), CURVES),
    Claim("fig13", "RD2-TD3, without TDQA, ends lowest", "least favourable",
          of(ahead, SCENARIOS, [RD2], [PHIL, RD2_PHIL], quantities=BOTH,
               sign=-1.0), CURVES),
    *(
        Claim("ablation", f"{part} is effective", "effective",
              of(ahead, SCENARIOS, [PHIL], [without], quantities=BOTH), CURVES)
        for part, without in (
            ("behaviour cloning", Line("phil_without_cloning")),
            ("the priority of human demonstrations", IA),
            ("intervention-based shaping", Line("phil_without_shaping")),
        )
    ),
    Claim("fig14", "poor guidance hardly changes PHIL-TD3's distance in any of six scenes",
          "nearly 50:50",
          partial(changed, line=PHIL, judged=partial(within, reach=NEARLY),
                  groups=[(scene,) for scene in PAPER_SCENES])),
    Claim("fig14", "poor guidance degrades IA-TD3", "-2.1 %",
          partial(changed, line=IA, judged=lambda one: above(one.times(-1.0)))),
    Claim("fig14", "poor guidance does not degrade HI-TD3", "+3.6 %",
          partial(changed, line=HI, judged=partial(above, least=-NEARLY))),
    Claim("fig14", "PHIL-TD3 is more robust to poor guidance than IA-TD3", "more",
          partial(changed, line=PHIL, judged=above, than=IA)),
    *(
        Claim("fig15", f"{words}: PHIL-TD3 is the smoothest after poor guidance", "smoothest",
              of(ahead, _scenes(scenario), [POOR_PHIL], [POOR_IA, POOR_HI], quantities=[quantity],
                 sign=-1.0))
        for words, scenario, quantity in (
            ("left turn", LEFT, LONGITUDINAL), ("congestion", JAM, LATERAL))
    ),
)  # fmt: skip
"""All that the paper says of its results, save of the time, which is measured apart."""


BARS: tuple[tuple[str, Judge], ...] = (
    *(
        (f"{name_of(line)}, {place.replace('_', ' ')}: success at least 85 %",
         partial(success_bar, scene=Scene(place, "nominal"), line=line, least=0.85))
        for line, place in product((PER, HI), SCENARIOS)
    ),
    *(
        (f"{name_of(line)}, {place.replace('_', ' ')}: above the best constant action",
         of(ahead, [Scene(place, "nominal")], [line], [FLOOR],
                 quantities=[SUCCESS]))
        for line, place in product((PER, HI), SCENARIOS)
    ),
    *(
        (f"PHIL-TD3, {scene.label}: success at least {100 * least:.0f} %",
         partial(success_bar, scene=scene, line=PHIL, least=least))
        for scene, least in zip(PAPER_SCENES, (0.99, 0.98, 0.96) * 2, strict=True)
    ),
    ("PHIL-TD3 ahead of its human in success or distance in at least four of six scenes",
     partial(ahead_in, least=4)),
    *(
        (f"{place.replace('_', ' ')}: PHIL-TD3 alone at 90 % {words}",
         of(sooner, [place], [PHIL], [other], quantities=[SUCCESS],
                 times=times, least=0.9, by_mean=True))
        for place in SCENARIOS
        for words, other, times in (
            ("in at most a third of vanilla TD3's steps", PER, 3.0),
            ("in no more steps than IA-TD3", IA, 1.0),
        )
    ),
    ("with biased guidance PHIL-TD3 ends ahead of IA-TD3 in at least one scenario",
     partial(either, judges=[
         of(ahead, [place], [BIASED_PHIL], [BIASED_IA], quantities=[SUCCESS])
         for place in SCENARIOS])),
    *(
        (f"PHIL-TD3, {place.replace('_', ' ')}: ends at most 2 points below its best",
         partial(unlearned, place=place, line=PHIL))
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
        alone = claim.judge(results, ALONE) if claim.curves else None
        yield Judged(claim, claim.judge(results, TRAINING), alone)


def judge_bars(results: Results) -> Iterator[tuple[str, Finding]]:
    """Every bar."""
    for text, bar in BARS:
        yield text, bar(results, ALONE)
