"""Judges: what a claim comes to, measured on the records.

A claim is about algorithms, so the numbers compared are one a training seed, paired by seed. It
holds, or does not, where a 95 % interval lies on one side; else it is undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial, wraps
from itertools import pairwise, permutations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    BySeed,
    Line,
    Result,
    Results,
    Scene,
    grid_of,
)
from trainer.experiments.plan import FOUR, LABELS, NORMAL, ONE_FRAME, PAPER_TESTS, RANDOM, SCENARIOS
from trainer.experiments.statistics import (
    NOTHING,
    RESAMPLES,
    Estimate,
    Holds,
    Numbers,
    above,
    all_of,
    bootstrap,
    mean_estimate,
    within,
)

Judge = Callable[[Results, str], "Finding"]
"""Of the results, and of a kind of curves: those in training or those of the policy alone."""
Place = str | Scene
"""A scenario, of whose trainings a claim speaks, or a scene of the tests."""
SAME_LEVEL = 0.05
"""What is on one level differs by no more than this share, or by so much success."""
UNITS = {
    SUCCESS: (100.0, 1, " points"),
    DISTANCE: (1.0, 2, " m"),
    SPREAD: (1.0, 2, " m"),
    REWARD: (1.0, 2, ""),
    TIME_S: (1.0, 2, " s"),
    LATERAL: (1.0, 3, " m/s²"),
    LONGITUDINAL: (1.0, 3, " m/s²"),
}
"""Quantity -> factor, digits and unit as it is shown."""
WORDS = {DISTANCE: "distance", REWARD: "reward", SUCCESS: "success"}
PHIL, IA, HI, PER = map(Line, FOUR)


class Finding(NamedTuple):
    """What was measured about a claim."""

    holds: Holds
    ours: str
    """The worst of the comparisons that decide, in words."""


class Comparison(NamedTuple):
    """One of those that a claim makes: it holds where all of them do."""

    text: str
    holds: Holds
    margin: float
    """How far on the good side it is; nan where nothing is measured."""
    needs: Sequence[tuple[str, Line]]
    """Scenarios and lines whose trainings must all be there."""


def decided(judge: Callable[..., Iterator[Comparison]]) -> Callable[..., Finding]:
    """A judge that takes all of the comparisons together; undecided where trainings are missing."""

    @wraps(judge)
    def finding(results: Results, kind: str, **arguments: Any) -> Finding:
        made = list(judge(results, kind, **arguments))
        holds = all_of([one.holds for one in made])
        measured = [one for one in made if one.holds == holds and not np.isnan(one.margin)]
        if not measured:
            return Finding("undecided", "not measured")
        complete = all(results.complete(*need) for one in made for need in one.needs)
        worst = min(measured, key=lambda one: one.margin)
        return Finding(holds if complete else "undecided", worst.text)

    return finding


def name_of(line: Line) -> str:
    """An algorithm in words, with its setting where that is not the normal one."""
    setting = "" if line.setting == NORMAL else f" ({line.setting.replace('_', ' ')})"
    return LABELS[line.algorithm] + setting


def _words(place: Place) -> str:
    return place.replace("_", " ") if isinstance(place, str) else place.label


def _one_frame(line: Line) -> Line:
    return Line(line.algorithm, ONE_FRAME)


def difference(first: BySeed, second: BySeed) -> Estimate:
    """Mean of first minus second over the seeds that both have."""
    return mean_estimate(first[seed] - second[seed] for seed in first if seed in second)


def in_units(one: Estimate, quantity: str) -> str:
    """A difference of a quantity in words."""
    factor, digits, unit = UNITS[quantity]
    return one.times(factor).text(digits) + unit


def _percent(one: Estimate) -> str:
    return f"{one.times(100.0).text(1)} %"


@decided
def ahead(
    results: Results,
    kind: str,
    places: Sequence[Place],
    ours: Sequence[Line],
    others: Sequence[Line],
    quantities: Sequence[str] = (DISTANCE,),
    sign: float = 1.0,
) -> Iterator[Comparison]:
    """Whether each of ours is above (sign -1: below) each of the others in every place; with sign
    0, whether it is on their level.
    """
    for place, quantity, first, second in product(places, quantities, ours, others):
        if isinstance(place, Scene):
            own, scenario = results.tested(place, first, quantity), place.scenario
            one = mean_estimate(results.differences(place, first, second, quantity).values())
        else:
            own, scenario = results.ends(place, first, kind, quantity), place
            one = difference(own, results.ends(place, second, kind, quantity))
        scale = 1.0 if quantity == SUCCESS else abs(mean_estimate(own.values()).value)
        text = (
            f"{in_units(one, quantity)}: {name_of(first)} over {name_of(second)}, {_words(place)}"
        )
        text += f", {WORDS.get(quantity, quantity)}" if len(quantities) > 1 else ""
        holds = above(one.times(sign)) if sign else within(one, SAME_LEVEL * scale)
        margin = sign * one.value if sign else -abs(one.value)
        yield Comparison(text, holds, margin, [(scenario, first), (scenario, second)])


level = partial(ahead, sign=0.0)


def first_reached(grid: Numbers, curve: Numbers, least: float) -> float:
    """Steps until a curve first reaches a level, between two points on a straight line."""
    places = np.flatnonzero(curve >= least - 1e-9)
    if not len(places):
        return float("inf")
    place = int(places[0])
    if place == 0:
        return float(grid[0])
    below, there = curve[place - 1], curve[place]
    part = (least - below) / (there - below)
    return float(grid[place - 1] + part * (grid[place] - grid[place - 1]))


def steps_to(results: Sequence[Result], least: float, kind: str = ALONE) -> float:
    """Steps until the mean of the seeds first reaches a success rate."""
    if not results:
        return float("nan")
    curves = np.stack([result.curve(kind, SUCCESS) for result in results])
    return first_reached(grid_of(results[0].budget), curves.mean(axis=0), least)


def sooner_by(
    own: Sequence[Result],
    other: Sequence[Result],
    kind: str,
    quantity: str,
    common: bool = False,
    least: float | None = None,
) -> tuple[Estimate, str]:
    """How many times as soon one line gets where another one ends, and both in steps.

    Args:
        own: the trainings of one line.
        other: of the other.
        kind: in training, or the policy alone.
        quantity: of the curves.
        common: the level is the lower end of the two, so that both can reach it.
        least: the level, where it is given.

    Who never gets there does so somewhere beyond the budget, so that the ratio has bounds, and its
    interval, a bootstrap over the seeds of both, reaches from the lower bounds to the upper ones.
    """
    if not own or not other:
        return NOTHING, ""
    grid = grid_of(own[0].budget)
    curves = [np.stack([r.curve(kind, quantity) for r in each]) for each in (own, other)]
    ends = [np.array([r.end(kind, quantity) for r in each]) for each in (own, other)]

    def reached(rows: Sequence[NDArray[np.int64]]) -> tuple[float, float]:
        goal = least
        if goal is None:
            means = [end[row].mean() for end, row in zip(ends, rows, strict=True)]
            goal = min(means) if common else means[1]
        first, second = (
            first_reached(grid, curve[row].mean(axis=0), goal)
            for curve, row in zip(curves, rows, strict=True)
        )
        return first, second

    budget, random = float(grid[-1]), np.random.default_rng(0)
    counts = [len(curve) for curve in curves]
    drawn = [
        reached([random.integers(count, size=count) for count in counts]) for _ in range(RESAMPLES)
    ]
    least_ratios = [min(second, budget) / first for first, second in drawn]
    most_ratios = [second / min(first, budget) for first, second in drawn]
    first, second = reached([np.arange(count) for count in counts])
    said = [f"{steps:,.0f}" if np.isfinite(steps) else "never" for steps in (first, second)]
    found = bootstrap(least_ratios, min(second, budget) / first, min(counts))
    found = found._replace(high=bootstrap(most_ratios, 0.0, min(counts)).high)
    return found, f"{said[0]} against {said[1]} steps"


def best_of(results: Results, place: str, lines: Sequence[Line], kind: str, quantity: str) -> Line:
    """The line that ends highest; the first where there is none at all."""
    ends = {line: results.ends(place, line, kind, quantity).values() for line in lines}
    return max(lines, key=lambda line: np.mean([*ends[line]]) if ends[line] else -np.inf)


@decided
def sooner(
    results: Results,
    kind: str,
    places: Sequence[str],
    ours: Sequence[Line],
    others: Sequence[Line],
    quantities: Sequence[str] = (DISTANCE,),
    times: float = 1.0,
    common: bool = False,
    least: float | None = None,
    best: bool = False,
    by_mean: bool = False,
) -> Iterator[Comparison]:
    """Whether each of ours is so many times as soon as each of the others, or as the best of them.

    With ``by_mean`` the ratio itself decides, not its interval; a lower bound of it only says yes.
    """
    for place, quantity in product(places, quantities):
        rivals = [best_of(results, place, others, kind, quantity)] if best else others
        for first, second in product(ours, rivals):
            own, other = results.of(place, first), results.of(place, second)
            one, steps = sooner_by(own, other, kind, quantity, common, least)
            text = f"{one.text(1)} times, {steps}: {name_of(first)} before {name_of(second)}"
            text += f", {_words(place)}"
            text += f", {WORDS[quantity]}" if len(quantities) > 1 else ""
            holds = above(one, times)
            if by_mean and one.size:
                bound: Holds = "undecided" if steps.endswith("never steps") else "no"
                holds = "yes" if one.value >= times else bound
            needs = [(place, line) for line in (first, *others)]
            yield Comparison(text, holds, one.value - times, needs)


def kept_shares(results: Results, scenario: str, line: Line, kind: str) -> BySeed:
    """Seed -> its part in the ratio of the final distances, one frame over two.

    The mean of these is the ratio of the means, and their spread that ratio's to first order. A
    mean of the seeds' own ratios would be ruled by whichever learned next to nothing with two.
    """
    two = results.ends(scenario, line, kind, DISTANCE)
    one = results.ends(scenario, _one_frame(line), kind, DISTANCE)
    seeds = sorted(two.keys() & one.keys())
    mean = float(np.mean([two[seed] for seed in seeds])) if seeds else 0.0
    if not mean:
        return {}
    ratio = float(np.mean([one[seed] for seed in seeds])) / mean
    return {seed: ratio + (one[seed] - ratio * two[seed]) / mean for seed in seeds}


@decided
def kept(
    results: Results, kind: str, places: Sequence[str], ours: Sequence[Line], others: Sequence[Line]
) -> Iterator[Comparison]:
    """Whether each of ours keeps a larger share of its distance with one frame than the others."""
    for place, first, second in product(places, ours, others):
        one = difference(*(kept_shares(results, place, line, kind) for line in (first, second)))
        text = f"{_percent(one)}: {name_of(first)} over {name_of(second)}, {_words(place)}"
        lines = (first, second, _one_frame(first), _one_frame(second))
        yield Comparison(text, above(one), one.value, [(place, line) for line in lines])


@decided
def lost(
    results: Results, kind: str, places: Sequence[str], ours: Sequence[Line]
) -> Iterator[Comparison]:
    """Whether one frame instead of two costs each of ours a share of its distance."""
    for place, line in product(places, ours):
        shares = kept_shares(results, place, line, kind)
        one = mean_estimate(1.0 - share for share in shares.values())
        text = f"{_percent(one)} lost: {name_of(line)}, {_words(place)}"
        yield Comparison(text, above(one), one.value, [(place, line), (place, _one_frame(line))])


@decided
def dropped(
    results: Results, kind: str, places: Sequence[str], ours: Sequence[Line]
) -> Iterator[Comparison]:
    """Whether the variant scene costs each of ours success."""
    for place, line in product(places, ours):
        scenes = (Scene(place, condition) for condition in ("nominal", "variant"))
        one = difference(*(results.tested(scene, line, SUCCESS) for scene in scenes))
        text = f"{in_units(one, SUCCESS)} lost: {name_of(line)}, {_words(place)}"
        yield Comparison(text, above(one), one.value, [(place, line)])


@decided
def same_ranking(
    results: Results, kind: str, places: Sequence[str], lines: Sequence[Line]
) -> Iterator[Comparison]:
    """Whether the lines end in one order with two frames and with one.

    Yes where every neighbour is ahead in both, no where two have changed places for sure.
    """
    numbers = range(len(lines))
    for place in places:
        settings = (lines, [_one_frame(line) for line in lines])
        both = [[results.ends(place, line, kind, DISTANCE) for line in each] for each in settings]
        means = [[mean_estimate(end.values()).value for end in ends] for ends in both]
        orders = [list(np.argsort(np.negative(each), kind="stable")) for each in means]
        swapped = any(
            above(difference(both[0][i], both[0][j])) == "yes"
            and above(difference(both[1][i], both[1][j])) == "no"
            for i, j in permutations(numbers, 2)
        )
        apart = all(
            above(difference(ends[i], ends[j])) == "yes"
            for ends, order in zip(both, orders, strict=True)
            for i, j in pairwise(order)
        )
        shown = [" > ".join(name_of(lines[i]) for i in order) for order in orders]
        same: Holds = "yes" if apart and orders[0] == orders[1] else "undecided"
        text = f"{_words(place)}: two frames {shown[0]}, one {shown[1]}"
        needs = [(place, line) for each in settings for line in each]
        yield Comparison(text, "no" if swapped else same, float(np.sum(means)), needs)


def changes(results: Results, line: Line, scenes: Sequence[Scene]) -> BySeed:
    """Seed -> relative change of the surviving distance by random poor guidance, over scenes."""
    by_seed: dict[int, list[float]] = {}
    for scene in scenes:
        good = results.tested(scene, line, DISTANCE)
        poor = results.tested(scene, Line(line.algorithm, RANDOM), DISTANCE)
        for seed in good.keys() & poor.keys():
            by_seed.setdefault(seed, []).append(poor[seed] / good[seed] - 1.0)
    return {seed: float(np.mean(values)) for seed, values in by_seed.items()}


@decided
def changed(
    results: Results,
    kind: str,
    line: Line,
    judged: Callable[[Estimate], Holds],
    than: Line | None = None,
    groups: Sequence[Sequence[Scene]] = (PAPER_SCENES,),
) -> Iterator[Comparison]:
    """How random poor guidance changes a line's distance, or how much more than another's."""
    lines = [line, than] if than else [line]
    poor = [Line(one.algorithm, RANDOM) for one in lines]
    for scenes in groups:
        found = [changes(results, one, scenes) for one in lines]
        one = difference(*found) if than else mean_estimate(found[0].values())
        where = scenes[0].label if len(scenes) == 1 else "mean of the scenes"
        text = f"{_percent(one)}: {' against '.join(map(name_of, lines))}, {where}"
        yield Comparison(
            text, judged(one), -abs(one.value), list(product(SCENARIOS, [*lines, *poor]))
        )


@decided
def success_bar(
    results: Results, kind: str, scene: Scene, line: Line, least: float
) -> Iterator[Comparison]:
    """Whether the mean of the seeds' success is at least so much."""
    one = mean_estimate(results.tested(scene, line, SUCCESS).values())
    found = results.of(scene.scenario, line)
    text = f"{one.as_share()} %"
    for words, part in ((f"the paper's {PAPER_TESTS} seeds", slice(PAPER_TESTS)),
                        ("others", slice(PAPER_TESTS, None))):  # fmt: skip
        drives = [result.drives(scene.condition, SUCCESS)[part] for result in found]
        text += f"; {words} {100 * np.mean(drives):.1f} %" if np.size(drives) else ""
    holds: Holds = "yes" if one.value >= least - 1e-9 else "no"
    yield Comparison(text, holds, one.value, [(scene.scenario, line)])


@decided
def ahead_in(results: Results, kind: str, least: int) -> Iterator[Comparison]:
    """Whether PHIL-TD3 is ahead of its human in success or distance in so many scenes."""
    said = []
    for scene in PAPER_SCENES:
        for quantity in (SUCCESS, DISTANCE):
            one = mean_estimate(results.differences(scene, PHIL, HUMAN, quantity).values())
            if above(one) == "yes":
                said.append(f"{scene.label} {in_units(one, quantity)}")
                break
    holds: Holds = "yes" if len(said) >= least else "no"
    needs = list(product(SCENARIOS, [PHIL, HUMAN]))
    yield Comparison(f"{len(said)} of 6: {', '.join(said)}", holds, len(said), needs)


UNLEARNED = 0.02
LATE = 3
"""Validations whose mean counts: a single one of 50 drives is off by some points."""


@decided
def unlearned(results: Results, kind: str, place: str, line: Line) -> Iterator[Comparison]:
    """Whether the policy alone ends at most 2 points below its best, as a mean of the seeds."""
    below = []
    for result in results.of(place, line):
        _, values = result.points(ALONE, SUCCESS)
        width = min(LATE, len(values))
        means = np.convolve(values, np.full(width, 1.0 / width), "valid")
        below.append(float(means.max() - means[-1]))
    one = mean_estimate(below)
    holds: Holds = "yes" if one.value <= UNLEARNED else "no"
    yield Comparison(in_units(one, SUCCESS), holds, -one.value, [(place, line)])


def either(results: Results, kind: str, judges: Sequence[Judge]) -> Finding:
    """Whether one of several claims holds, and the one that says most for it."""
    findings = [judge(results, kind) for judge in judges]
    order = ("yes", "undecided", "no")
    return min(findings, key=lambda finding: order.index(finding.holds))
