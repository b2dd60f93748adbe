"""The paper's claims: what is compared, over what, in which direction, and what we measured.

A claim is about algorithms, so the numbers compared are one a training seed, paired by seed. A
comparison holds, or does not, where its 95 % interval lies on one side of the bar; else it is
undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise, permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.statistics import NOTHING, Estimate, bootstrap, mean_estimate
from trainer.environments import CONDITIONS
from trainer.experiments import data, plan
from trainer.experiments.data import Holds, Line, Numbers, Place, Result, Results
from trainer.training.metrics import LEARNED

UNITS = {
    data.SUCCESS: (100.0, 1, " points"),
    data.DISTANCE: (1.0, 2, " m"),
    data.SPREAD: (1.0, 2, " m"),
    data.REWARD: (1.0, 2, ""),
    data.TIME_S: (1.0, 2, " s"),
    data.SECONDS: (1.0, 1, " s"),
    data.LATERAL: (1.0, 3, " m/s²"),
    data.LONGITUDINAL: (1.0, 3, " m/s²"),
    data.KEPT: (100.0, 1, " % of the distance kept"),
    data.DROPPED: (100.0, 1, " points less than in the nominal scene"),
    data.CHANGED: (100.0, 1, " % further than after good guidance"),
    data.UNLEARNED: (100.0, 1, " points below the best validation"),
}
"""Quantity -> factor, digits and unit as it is shown."""
SHORT = {data.DISTANCE: "distance", data.REWARD: "reward", data.SUCCESS: "success"}
SAME_LEVEL = 0.05  # What is on one level differs by no more than this share, or by so much success
NEARLY = 0.02
"""Share of the distance that poor guidance may change where the paper says nearly 50:50."""
RESAMPLES = 2000
OF_CURVES = ("fig7", "fig8", "fig11", "fig12", "fig13", "ablation")
"""Their claims speak of training curves, in which the human helps: judged of the policy alone,
too."""


class Claim(NamedTuple):
    """A row: what the paper says, and the comparisons by which it is judged."""

    source: str  # Experiment, and figure or table of the paper
    text: str
    paper: str  # Its number or word
    test: Callable[[Results, str, Claim], Iterator[Comparison]]
    """Makes the comparisons, with curves in training or of the policy alone."""
    places: Sequence[Place]
    ours: Sequence[Line]
    others: Sequence[Line | None] = (None,)
    """None: not compared with another line, but with ``bar``."""
    quantities: Sequence[str] = (data.DISTANCE,)
    bar: float = 0.0
    """What the difference is to be above or below, how near a level is, how many times as soon."""
    enough: int = 0  # So many comparisons must hold; 0: all


class Comparison(NamedTuple):
    """One of those that a claim makes."""

    text: str
    holds: Holds
    margin: float
    """How far on the good side it is, by which the weakest is found; nan: nothing is measured."""
    complete: bool  # Whether all trainings are there


def judge(results: Results, claim: Claim, kind: str) -> Comparison:
    """A claim's verdict, with the weakest of the comparisons that give it; undecided where
    trainings are missing.
    """
    made = list(claim.test(results, kind, claim))
    verdicts = [one.holds for one in made]
    holds = data.enough_of(verdicts, claim.enough)
    measured = [one for one in made if one.holds == holds and not np.isnan(one.margin)]
    if not measured:
        return Comparison("not measured", "undecided", float("nan"), False)
    weakest = min(measured, key=lambda one: one.margin)
    if len(made) > 1:
        good = f"{verdicts.count('yes')} of {len(made)} hold; "
        weakest = weakest._replace(text=good + weakest.text)
    return weakest if all(one.complete for one in made) else weakest._replace(holds="undecided")


def judge_both(results: Results, claim: Claim) -> tuple[Comparison, Comparison | None]:
    """As the paper does, with training curves; and of the policy alone, where it has curves."""
    alone = judge(results, claim, data.ALONE) if claim.source in OF_CURVES else None
    return judge(results, claim, data.TRAINING), alone


def ahead(results: Results, kind: str, claim: Claim, sign: float = 1.0) -> Iterator[Comparison]:
    """Whether each of ours is above (sign -1: below) each of the others in every place; with sign
    0, whether it is on their level.
    """
    for place, quantity, first, second in product(
        claim.places, claim.quantities, claim.ours, claim.others
    ):
        own = results.estimate(place, first, quantity, kind)
        complete = results.complete(place, first, quantity)
        one, over = own, ""
        if second:
            found = results.differences(place, first, second, quantity, kind)
            one, over = mean_estimate(found.values()), f" minus {second.name}"
            complete = complete and results.complete(place, second, quantity)
        bar, (factor, digits, unit) = claim.bar, UNITS[quantity]
        if sign:
            holds, margin = data.above(one.times(sign), sign * bar), sign * (one.value - bar)
        else:
            scale = 1.0 if quantity == data.SUCCESS else abs(own.value)
            bar = bar or SAME_LEVEL * scale
            holds, margin = data.within(one, bar), bar - abs(one.value)
        said = f", bar {'' if sign else '±'}{factor * bar:.{digits}f}" if bar else ""
        text = f"{one.times(factor).text(digits)}{unit}{said}: {first.name}{over}, "
        margin /= max(one.high - one.low, 1e-9)
        yield Comparison(text + _where(claim, place, quantity), holds, margin, complete)


behind, level = partial(ahead, sign=-1.0), partial(ahead, sign=0.0)


def _where(claim: Claim, place: Place, quantity: str) -> str:
    return data.words(place) + (f", {SHORT[quantity]}" if len(claim.quantities) > 1 else "")


def sooner(
    results: Results,
    kind: str,
    claim: Claim,
    common: bool = False,
    best: bool = False,
    level: float | None = None,
) -> Iterator[Comparison]:
    """Whether each of ours reaches the other's final level more than ``bar`` times as soon.

    The claim's others must be named. ``common``: the level is the lower
    end of the two, so that both can reach it; ``best``: only the best of the others counts;
    ``level``: a level of the policy alone instead.
    """
    kind = kind if level is None else data.ALONE
    for place, quantity in product(claim.places, claim.quantities):

        def ended(line: Line, place: Place = place, quantity: str = quantity) -> float:
            value = results.estimate(place, line, quantity, kind).value
            return -np.inf if np.isnan(value) else value

        others = [line for line in claim.others if line]
        everybody = [*claim.ours, *others]
        complete = all(results.complete(place, line, quantity) for line in everybody)
        for first, second in product(claim.ours, [max(others, key=ended)] if best else others):
            own, other = (results.of(str(place), line) for line in (first, second))
            one, steps = sooner_by(own, other, kind, quantity, common, level)
            times = claim.bar or 1.0
            found = f"{one.text(1)} times as soon, bar {times:g} ({steps})"
            if np.isnan(one.value) and (one.low, one.high) == (0.0, np.inf):
                found = f"cannot be compared ({steps})"
            where = _where(claim, place, quantity)
            text = f"{found}: {first.name} against {second.name}, {where}"
            holds = data.above(one, times)
            end = one.high if holds == "no" else one.low
            yield Comparison(text, holds, end - times if one.size else np.nan, complete)


sooner_to_common, sooner_than_best = partial(sooner, common=True), partial(sooner, best=True)
sooner_learned = partial(sooner, level=LEARNED[0])


def sooner_by(
    own: Sequence[Result],
    other: Sequence[Result],
    kind: str,
    quantity: str,
    common: bool = False,
    level: float | None = None,
) -> tuple[Estimate, str]:
    """How many times as soon one line gets where another one ends, and both in steps.

    A line that is there at the first look got there at an unknown step before; one that never
    is, at one beyond the budget. So the ratio has bounds. Its interval, a bootstrap that draws the
    same seeds for both, reaches from the lower bounds to the upper.
    """
    if not own or not other:
        return NOTHING, ""
    grid = own[0].grid
    curves = [np.stack([r.curve(kind, quantity) for r in each]) for each in (own, other)]
    ends = [np.array([r.end(kind, quantity) for r in each]) for each in (own, other)]
    looked = [max(r.points(kind, quantity)[0][0] for r in each) for each in (own, other)]

    def reached(rows: Sequence[NDArray[np.int64]]) -> list[Bounds]:
        means = [end[row].mean() for end, row in zip(ends, rows, strict=True)]
        goal = level if level is not None else min(means) if common else means[1]
        return [
            first_reached(grid, curve[row].mean(axis=0), goal, first)
            for curve, row, first in zip(curves, rows, looked, strict=True)
        ]

    random, seeds = np.random.default_rng(0), min(map(len, curves))
    drawn = [reached([random.integers(seeds, size=seeds)] * 2) for _ in range(RESAMPLES)]
    first, second = reached([np.arange(len(curve)) for curve in curves])
    exact = first.low == first.high and second.low == second.high
    point = second.low / first.low if exact else float("nan")
    lowest = bootstrap([its.low / ours.high for ours, its in drawn], point, seeds)
    ratios = [its.high / ours.low if ours.low else np.inf for ours, its in drawn]
    highest = bootstrap(ratios, point, seeds)
    return lowest._replace(high=highest.high), f"{first.said()} against {second.said()} steps"


class Bounds(NamedTuple):
    """Between which steps something happened; twice the same number where that is known."""

    low: float
    high: float

    def said(self) -> str:
        """As in "1,234", "within 500" and "over 6,000"."""
        if self.low == self.high:
            return f"{self.low:,.0f}"
        return f"within {self.high:,.0f}" if self.low == 0.0 else f"over {self.low:,.0f}"


def first_reached(grid: Numbers, curve: Numbers, least: float, looked: float = 0.0) -> Bounds:
    """Steps until a curve first reaches a level, between two points on a straight line.

    ``looked``: the step of the first measurement, which may lie after the first grid point.
    """
    places = np.flatnonzero(curve >= least - 1e-9)
    if not len(places):
        return Bounds(float(grid[-1]), float("inf"))
    place = int(places[0])
    if place == 0:
        return Bounds(0.0, max(float(grid[0]), looked))
    steps = np.interp(least, curve[place - 1 : place + 1], grid[place - 1 : place + 1])
    return Bounds(float(steps), float(steps))


def same_ranking(results: Results, kind: str, claim: Claim) -> Iterator[Comparison]:
    """Whether the lines end in one order with two frames and with one.

    Yes where every neighbour is ahead in both, no where two have changed places for sure.
    """
    settings = (claim.ours, [Line(line.algorithm, plan.ONE_FRAME) for line in claim.ours])
    for place in claim.places:

        def is_ahead(first: Line, second: Line, place: Place = place) -> Holds:
            found = results.differences(place, first, second, data.DISTANCE, kind)
            return data.above(mean_estimate(found.values()))

        means = [
            [results.estimate(place, x, data.DISTANCE, kind).value for x in s] for s in settings
        ]
        orders = [list(np.argsort(np.negative(each), kind="stable")) for each in means]
        swapped = any(
            is_ahead(*two) == "yes" and is_ahead(*one) == "no"
            for two, one in zip(*(permutations(lines, 2) for lines in settings), strict=True)
        )
        apart = all(
            is_ahead(lines[i], lines[j]) == "yes"
            for lines, order in zip(settings, orders, strict=True)
            for i, j in pairwise(order)
        )
        shown = [" > ".join(claim.ours[i].name for i in order) for order in orders]
        same: Holds = "yes" if apart and orders[0] == orders[1] else "undecided"
        text = f"{data.words(place)}: two frames {shown[0]}, one {shown[1]}"
        complete = all(results.complete(place, line, data.KEPT) for line in claim.ours)
        yield Comparison(text, "no" if swapped else same, float(np.sum(means)), complete)


LEFT, JAM = plan.SCENARIOS
LEFTS, JAMS = (
    [s for s in data.PAPER_SCENES if s.scenario == scenario] for scenario in plan.SCENARIOS
)
BOTH = (data.REWARD, data.DISTANCE)
PHIL, IA, HI, PER = map(Line, plan.FOUR)
BASELINES = (IA, HI, PER)
HUMAN = Line(plan.HUMAN_MODEL)
TD, ADVANTAGE = Line("phil_td_only"), Line("phil_q_advantage_only")
SMALL, LARGE = Line("phil_advantage_0.1"), Line("phil_advantage_100")
RD2_PHIL, RD2 = Line("rd2_phil"), Line("rd2_td3")
NO_CLONING, NO_SHAPING = Line("phil_without_cloning"), Line("phil_without_shaping")
POOR_PHIL, POOR_IA, POOR_HI = (Line(name, plan.RANDOM) for name in plan.GUIDED)
CLAIMS: tuple[Claim, ...] = (
    Claim("fig7", "left turn: PHIL-TD3 learns the best asymptotic policy", "best",
          ahead, [LEFT], [PHIL], BASELINES, BOTH),
    Claim("fig7", "left turn: PHIL-TD3, IA-TD3 and HI-TD3 end above vanilla TD3", "higher",
          ahead, [LEFT], [PHIL, IA, HI], [PER], BOTH),
    Claim("fig7", "left turn: these three get where it ends sooner", "in a much shorter time",
          sooner, [LEFT], [PHIL, IA, HI], [PER], BOTH),
    Claim("fig7", "left turn: HI-TD3 is the slowest of the guided", "slowest",
          sooner_to_common, [LEFT], [PHIL, IA], [HI], BOTH),
    Claim("fig7", "left turn: PHIL-TD3 reaches the best baseline's reward 8 times as soon",
          "over 700 % better", sooner_than_best, [LEFT], [PHIL], BASELINES, [data.REWARD], 8.0),
    Claim("fig7", "congestion: PHIL-TD3 and IA-TD3 have comparable rewards", "comparable",
          level, [JAM], [PHIL], [IA], [data.REWARD]),
    Claim("fig7", "congestion: their rewards are above those of HI-TD3 and vanilla TD3", "better",
          ahead, [JAM], [PHIL, IA], [HI, PER], [data.REWARD]),
    Claim("fig7", "congestion: PHIL-TD3 survives furthest", "highest",
          ahead, [JAM], [PHIL], BASELINES),
    Claim("fig7", "congestion: IA-TD3 and HI-TD3 survive comparably far", "comparable",
          level, [JAM], [IA], [HI]),
    Claim("fig7", "congestion: IA-TD3 learns faster than HI-TD3", "faster",
          sooner_to_common, [JAM], [IA], [HI]),
    Claim("fig7", "congestion: PHIL-TD3 reaches the best baseline's distance 2.2 times as soon",
          "over 120 % better", sooner_than_best, [JAM], [PHIL], BASELINES, [data.DISTANCE], 2.2),
    Claim("fig8", "one frame instead of two does not change the ranking", "same",
          same_ranking, plan.SCENARIOS, [PHIL, IA, HI, PER]),
    Claim("fig8", "PHIL-TD3 and IA-TD3 lose less by it than HI-TD3 and vanilla TD3", "less",
          ahead, plan.SCENARIOS, [PHIL, IA], [HI, PER], [data.KEPT]),
    Claim("fig8", "HI-TD3 and vanilla TD3 lose significantly by it", "significantly",
          behind, plan.SCENARIOS, [HI, PER], quantities=[data.KEPT], bar=1.0),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three left turns", "highest",
          ahead, LEFTS, [PHIL], BASELINES, [data.SUCCESS]),
    Claim("fig9", "PHIL-TD3 has the highest success rate in the three congestions", "highest",
          ahead, JAMS, [PHIL], BASELINES, [data.SUCCESS]),
    Claim("fig9", "PHIL-TD3 survives furthest in the three left turns", "furthest",
          ahead, LEFTS, [PHIL], BASELINES),
    Claim("fig9", "PHIL-TD3 survives furthest in the three congestions",
          "furthest; but in table II's variant IA-TD3 78.39 m, PHIL-TD3 77.29 m",
          ahead, JAMS, [PHIL], BASELINES),
    Claim("fig9", "PHIL-TD3's distance varies least from drive to drive", "lowest variance",
          behind, data.PAPER_SCENES, [PHIL], BASELINES, [data.SPREAD]),
    Claim("fig9", "vanilla TD3 is competitive with IA-TD3 and HI-TD3 in success", "competitive",
          level, data.PAPER_SCENES, [PER], [IA, HI], [data.SUCCESS]),
    Claim("fig9", "the variant scenes significantly degrade the three baselines", "significantly",
          ahead, plan.SCENARIOS, BASELINES, quantities=[data.DROPPED]),
    Claim("fig10", "left turn: PHIL-TD3 takes the least time", "least",
          behind, LEFTS, [PHIL], BASELINES, [data.TIME_S]),
    Claim("fig10", "congestion, nominal and noise: the guided are smoother than vanilla TD3",
          "smoother", behind, JAMS[:2], [PHIL, IA, HI], [PER], [data.LATERAL]),
    Claim("fig10", "congestion, variant: PHIL-TD3 is the smoothest", "smoothest",
          behind, JAMS[2:], [PHIL], BASELINES, [data.LATERAL]),
    Claim("table1", "left turn: PHIL-TD3 survives further than the human model",
          "21.28 to 20.70, 21.27 to 20.88, 21.29 to 20.90 m", ahead, LEFTS, [PHIL], [HUMAN]),
    Claim("table2", "congestion: PHIL-TD3 survives further than the human model",
          "80.15 to 80.11, 79.26 to 77.66, 77.29 to 75.15 m", ahead, JAMS, [PHIL], [HUMAN]),
    Claim("fig11", "TD error alone learns faster than the Q advantage alone", "faster",
          sooner_to_common, plan.SCENARIOS, [TD], [ADVANTAGE], BOTH),
    Claim("fig11", "the Q advantage alone ends significantly above TD error alone", "above",
          ahead, plan.SCENARIOS, [ADVANTAGE], [TD], BOTH),
    Claim("fig11", "both together (PHIL-TD3) end highest", "most favourable",
          ahead, plan.SCENARIOS, [PHIL], [TD, ADVANTAGE], BOTH),
    Claim("fig12", "weight 0.1 on the Q advantage converges faster than 1", "faster",
          sooner_to_common, plan.SCENARIOS, [SMALL], [PHIL], BOTH),
    Claim("fig12", "weight 0.1 ends below 1", "below",
          ahead, plan.SCENARIOS, [PHIL], [SMALL], BOTH),
    Claim("fig12", "weight 100 ends on the level of 1", "same level",
          level, plan.SCENARIOS, [PHIL], [LARGE], BOTH),
    Claim("fig13", "one buffer (PHIL-TD3) learns faster than two (RD2-PHIL)", "faster",
          sooner_to_common, plan.SCENARIOS, [PHIL], [RD2_PHIL], BOTH),
    Claim("fig13", "RD2-TD3, without the Q advantage, ends lowest", "least favourable",
          behind, plan.SCENARIOS, [RD2], [PHIL, RD2_PHIL], BOTH),
    Claim("ablation", "behaviour cloning is effective", "effective",
          ahead, plan.SCENARIOS, [PHIL], [NO_CLONING], BOTH),
    Claim("ablation", "the priority of human demonstrations is effective", "effective",
          ahead, plan.SCENARIOS, [PHIL], [IA], BOTH),
    Claim("ablation", "intervention-based shaping is effective", "effective",
          ahead, plan.SCENARIOS, [PHIL], [NO_SHAPING], BOTH),
    Claim("fig14", "poor guidance hardly changes PHIL-TD3's distance in any of six scenes",
          "nearly 50:50", level, data.PAPER_SCENES, [PHIL], quantities=[data.CHANGED], bar=NEARLY),
    Claim("fig14", "poor guidance degrades IA-TD3", "-2.1 %",
          behind, [data.EVERYWHERE], [IA], quantities=[data.CHANGED], bar=-NEARLY),
    Claim("fig14", "poor guidance does not degrade HI-TD3", "+3.6 %",
          ahead, [data.EVERYWHERE], [HI], quantities=[data.CHANGED], bar=-NEARLY),
    Claim("fig14", "poor guidance degrades IA-TD3 more than PHIL-TD3 and HI-TD3", "most",
          ahead, [data.EVERYWHERE], [PHIL, HI], [IA], [data.CHANGED]),
    Claim("fig15", "left turn: PHIL-TD3 is the smoothest after poor guidance", "smoothest",
          behind, LEFTS, [POOR_PHIL], [POOR_IA, POOR_HI], [data.LONGITUDINAL]),
    Claim("fig15", "congestion: PHIL-TD3 is the smoothest after poor guidance", "smoothest",
          behind, JAMS, [POOR_PHIL], [POOR_IA, POOR_HI], [data.LATERAL]),
    Claim("time", "PHIL-TD3 and IA-TD3 take a similar time to train", "similar, 1.03 times",
          level, [LEFT], [PHIL], [IA], [data.SECONDS]),
)  # fmt: skip
"""All that the paper says of its results."""
AS_PRINTED = tuple(
    claim._replace(
        source=plan.PRINTED,
        ours=[Line(line.algorithm, plan.PRINTED) for line in claim.ours],
        others=[line and Line(line.algorithm, plan.PRINTED) for line in claim.others],
    )
    for claim in CLAIMS
    if claim.source == "fig9" and claim.quantities in ([data.SUCCESS], [data.DROPPED])
)
"""Its claims of success once more, of the settings as it prints them."""
NOMINAL, NOISE, VARIANT, DENSE = (
    [scene for scene in data.SCENES if scene.condition == condition] for condition in CONDITIONS
)
GOALS: tuple[Claim, ...] = (
    Claim("goals", "vanilla TD3 and HI-TD3 learn to drive", "85 %",
          ahead, NOMINAL, [PER, HI], quantities=[data.SUCCESS], bar=0.85),
    Claim("goals", "vanilla TD3 and HI-TD3 are above the best constant action", "ahead",
          ahead, data.SCENES, [PER, HI], [Line(plan.CONSTANT)], [data.SUCCESS]),
    Claim("goals", "PHIL-TD3's success in the nominal scenes", "99 %",
          ahead, NOMINAL, [PHIL], quantities=[data.SUCCESS], bar=0.99),
    Claim("goals", "PHIL-TD3's success with command noise", "98 %",
          ahead, NOISE, [PHIL], quantities=[data.SUCCESS], bar=0.98),
    Claim("goals", "PHIL-TD3's success in the variants", "96 %",
          ahead, VARIANT, [PHIL], quantities=[data.SUCCESS], bar=0.96),
    Claim("goals", "PHIL-TD3 is ahead of its human in success", "in four of six scenes",
          ahead, data.PAPER_SCENES, [PHIL], [HUMAN], [data.SUCCESS], enough=4),
    Claim("goals", "PHIL-TD3 is ahead of its human in distance", "in four of six scenes",
          ahead, data.PAPER_SCENES, [PHIL], [HUMAN], enough=4),
    Claim("goals", "PHIL-TD3 learns to drive (90 % of the validations) sooner than vanilla TD3",
          "3 times as soon", sooner_learned, plan.SCENARIOS, [PHIL], [PER], [data.SUCCESS], 3.0),
    Claim("goals", "PHIL-TD3 learns to drive sooner than IA-TD3", "no later",
          sooner_learned, plan.SCENARIOS, [PHIL], [IA], [data.SUCCESS]),
    Claim("goals", "the end of PHIL-TD3's training is near its best validation", "2 points",
          behind, plan.SCENARIOS, [PHIL], quantities=[data.UNLEARNED], bar=0.02),
    Claim("goals", "PHIL-TD3 is ahead of the baselines in the dense scenes", "ahead",
          ahead, DENSE, [PHIL], BASELINES, [data.SUCCESS]),
    Claim("goals", "PHIL-TD3 is ahead of IA-TD3 after biased guidance", "in one scene",
          ahead, data.SCENES, [Line("phil_td3", plan.BIASED)], [Line("ia_td3", plan.BIASED)],
          [data.SUCCESS], enough=1),
    *(
        Claim("goals",
              f"{data.words(scenario)}: after biased guidance PHIL-TD3 is better without cloning",
              "if imitation is to blame", ahead,
              [scene for scene in data.SCENES if scene.scenario == scenario],
              [Line("phil_without_cloning", plan.BIASED)], [Line("phil_td3", plan.BIASED)],
              [data.SUCCESS])
        for scenario in plan.SCENARIOS
    ),
)  # fmt: skip
"""What this project wants of the learner, beyond what the paper says."""
