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
    BySeed,
    Line,
    Place,
    Result,
    Results,
    Scene,
    grid_of,
    words,
)
from trainer.experiments.plan import ONE_FRAME, PAPER_TESTS, RANDOM, SCENARIOS
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

SAME_LEVEL = 0.05
"""What is on one level differs by no more than this share, or by so much success."""
UNITS = {
    SUCCESS: (100.0, 1, " points"),
    DISTANCE: (1.0, 2, " m"),
    SPREAD: (1.0, 2, " m"),
    REWARD: (1.0, 2, ""),
    TIME_S: (1.0, 2, " s"),
    SECONDS: (1.0, 1, " s"),
    LATERAL: (1.0, 3, " m/s²"),
    LONGITUDINAL: (1.0, 3, " m/s²"),
    KEPT: (100.0, 1, " %"),
    LOST: (100.0, 1, " % lost"),
    DROPPED: (100.0, 1, " points lost"),
}
"""Quantity -> factor, digits and unit as it is shown."""
SHORT = {DISTANCE: "distance", REWARD: "reward", SUCCESS: "success"}
UNLEARNED = 0.02
"""Success by which a policy may end below its best."""
LATE = 3
"""Validations whose mean counts: a single one of 50 drives is off by some points."""


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


Judge = Callable[[Results, str], Finding]
"""Of the results, and of a kind of curves: those in training or those of the policy alone."""


def judge(compare: Callable[..., Iterator[Comparison]]) -> Callable[..., Judge]:
    """Make a function whose arguments say what is compared, and whose value judges the results.

    All comparisons count together; it is undecided where trainings are missing.
    """

    @wraps(compare)
    def of(*arguments: Any, **options: Any) -> Judge:
        def finding(results: Results, kind: str) -> Finding:
            made = list(compare(results, kind, *arguments, **options))
            holds = all_of([one.holds for one in made])
            measured = [one for one in made if one.holds == holds and not np.isnan(one.margin)]
            if not measured:
                return Finding("undecided", "not measured")
            complete = all(results.complete(*need) for one in made for need in one.needs)
            worst = min(measured, key=lambda one: one.margin)
            return Finding(holds if complete else "undecided", worst.text)

        return finding

    return of


def in_units(one: Estimate, quantity: str) -> str:
    """A difference of a quantity in words."""
    factor, digits, unit = UNITS[quantity]
    return one.times(factor).text(digits) + unit


def _poor(line: Line) -> Line:
    return Line(line.algorithm, RANDOM)


def _needed(place: Place, lines: Sequence[Line], quantity: str) -> list[tuple[str, Line]]:
    """What must be there to compare a quantity of these lines in this place."""
    if quantity in (KEPT, LOST):
        lines = [*lines, *(Line(line.algorithm, ONE_FRAME) for line in lines)]
    scenario = place.scenario if isinstance(place, Scene) else place
    return [(scenario, line) for line in lines]


@judge
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
        one = mean_estimate(results.differences(place, first, second, quantity, kind).values())
        text = f"{in_units(one, quantity)}: {first.name} over {second.name}, {words(place)}"
        text += f", {SHORT[quantity]}" if len(quantities) > 1 else ""
        if sign:
            holds, margin = above(one.times(sign)), sign * one.value
        else:
            own = mean_estimate(results.numbers(place, first, quantity, kind).values()).value
            scale = 1.0 if quantity == SUCCESS else abs(own)
            holds, margin = within(one, SAME_LEVEL * scale), -abs(one.value)
        yield Comparison(text, holds, margin, _needed(place, [first, second], quantity))


level = partial(ahead, sign=0.0)


@judge
def positive(
    results: Results, kind: str, places: Sequence[Place], lines: Sequence[Line], quantity: str
) -> Iterator[Comparison]:
    """Whether a quantity of each line, such as what it loses, is above zero in every place."""
    for place, line in product(places, lines):
        one = mean_estimate(results.numbers(place, line, quantity, kind).values())
        text = f"{in_units(one, quantity)}: {line.name}, {words(place)}"
        yield Comparison(text, above(one), one.value, _needed(place, [line], quantity))


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

    A line that never gets there does so somewhere beyond the budget, so the ratio has bounds, and
    its interval, a bootstrap over the seeds of both, reaches from the lower ones to the upper ones.

    Args:
        own: the trainings of one line.
        other: those of the other.
        kind: in training, or the policy alone.
        quantity: of the curves.
        common: the level is the lower end of the two, so that both can reach it.
        least: the level, where it is given.
    """
    if not own or not other:
        return NOTHING, ""
    grid = grid_of(own[0].budget)
    curves = [np.stack([r.curve(kind, quantity) for r in each]) for each in (own, other)]
    ends = [np.array([r.end(kind, quantity) for r in each]) for each in (own, other)]

    def reached(rows: Sequence[NDArray[np.int64]]) -> list[float]:
        means = [end[row].mean() for end, row in zip(ends, rows, strict=True)]
        goal = least if least is not None else min(means) if common else means[1]
        return [
            first_reached(grid, curve[row].mean(axis=0), goal)
            for curve, row in zip(curves, rows, strict=True)
        ]

    budget, random = float(grid[-1]), np.random.default_rng(0)
    counts = [len(curve) for curve in curves]
    drawn = [
        reached([random.integers(count, size=count) for count in counts]) for _ in range(RESAMPLES)
    ]
    first, second = reached([np.arange(count) for count in counts])
    lowest = bootstrap(
        [min(its, budget) / ours for ours, its in drawn], min(second, budget) / first, min(counts)
    )
    highest = bootstrap([its / min(ours, budget) for ours, its in drawn], 0.0, min(counts))
    said = [f"{steps:,.0f}" if np.isfinite(steps) else "never" for steps in (first, second)]
    return lowest._replace(high=highest.high), f"{said[0]} against {said[1]} steps"


def best_of(results: Results, place: str, lines: Sequence[Line], kind: str, quantity: str) -> Line:
    """The line that ends highest; the first where there is none at all."""
    ends = {line: results.numbers(place, line, quantity, kind).values() for line in lines}
    return max(lines, key=lambda line: np.mean([*ends[line]]) if ends[line] else -np.inf)


@judge
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
            text = f"{one.text(1)} times, {steps}: {first.name} before {second.name}"
            text += f", {words(place)}"
            text += f", {SHORT[quantity]}" if len(quantities) > 1 else ""
            holds = above(one, times)
            if by_mean and one.size:
                bound: Holds = "undecided" if steps.endswith("never steps") else "no"
                holds = "yes" if one.value >= times else bound
            needs = _needed(place, [first, *others], quantity)
            yield Comparison(text, holds, one.value - times, needs)


@judge
def same_ranking(
    results: Results, kind: str, places: Sequence[str], lines: Sequence[Line]
) -> Iterator[Comparison]:
    """Whether the lines end in one order with two frames and with one.

    Yes where every neighbour is ahead in both, no where two have changed places for sure.
    """
    settings = (lines, [Line(line.algorithm, ONE_FRAME) for line in lines])
    for place in places:

        def is_ahead(each: Sequence[Line], i: int, j: int, place: str = place) -> Holds:
            found = results.differences(place, each[i], each[j], DISTANCE, kind)
            return above(mean_estimate(found.values()))

        numbers = [[results.numbers(place, x, DISTANCE, kind) for x in each] for each in settings]
        means = [[mean_estimate(each.values()).value for each in ends] for ends in numbers]
        orders = [list(np.argsort(np.negative(each), kind="stable")) for each in means]
        swapped = any(
            is_ahead(settings[0], i, j) == "yes" and is_ahead(settings[1], i, j) == "no"
            for i, j in permutations(range(len(lines)), 2)
        )
        apart = all(
            is_ahead(each, i, j) == "yes"
            for each, order in zip(settings, orders, strict=True)
            for i, j in pairwise(order)
        )
        shown = [" > ".join(lines[i].name for i in order) for order in orders]
        same: Holds = "yes" if apart and orders[0] == orders[1] else "undecided"
        text = f"{words(place)}: two frames {shown[0]}, one {shown[1]}"
        needs = _needed(place, lines, KEPT)
        yield Comparison(text, "no" if swapped else same, float(np.sum(means)), needs)


def changes(results: Results, line: Line, scenes: Sequence[Scene]) -> BySeed:
    """Seed -> relative change of the surviving distance by random poor guidance, over scenes."""
    by_seed: dict[int, list[float]] = {}
    for scene in scenes:
        good, poor = (results.numbers(scene, one, DISTANCE) for one in (line, _poor(line)))
        for seed in good.keys() & poor.keys():
            by_seed.setdefault(seed, []).append(poor[seed] / good[seed] - 1.0)
    return {seed: float(np.mean(values)) for seed, values in by_seed.items()}


@judge
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
    needs = list(product(SCENARIOS, [*lines, *map(_poor, lines)]))
    for scenes in groups:
        own, *others = (changes(results, one, scenes) for one in lines)
        for its in others:
            own = {seed: own[seed] - its[seed] for seed in own if seed in its}
        one = mean_estimate(own.values())
        where = scenes[0].label if len(scenes) == 1 else "mean of the scenes"
        text = f"{one.times(100.0).text(1)} %: {' against '.join(x.name for x in lines)}, {where}"
        yield Comparison(text, judged(one), -abs(one.value), needs)


@judge
def success_bar(
    results: Results, kind: str, scene: Scene, line: Line, least: float
) -> Iterator[Comparison]:
    """Whether the mean of the seeds' success is at least so much."""
    one = mean_estimate(results.numbers(scene, line, SUCCESS).values())
    text = f"{one.as_share()} %"
    for whose, part in ((f"the paper's {PAPER_TESTS} seeds", slice(PAPER_TESTS)),
                        ("others", slice(PAPER_TESTS, None))):  # fmt: skip
        found = results.of(scene.scenario, line)
        drives = [result.drives(scene.condition, SUCCESS)[part] for result in found]
        text += f"; {whose} {100 * np.mean(drives):.1f} %" if np.size(drives) else ""
    holds: Holds = "yes" if one.value >= least - 1e-9 else "no"
    yield Comparison(text, holds, one.value, _needed(scene, [line], SUCCESS))


@judge
def ahead_in(
    results: Results, kind: str, ours: Line, other: Line, least: int
) -> Iterator[Comparison]:
    """Whether a line is ahead of another in success or distance in so many of the six scenes."""
    said = []
    for scene in PAPER_SCENES:
        for quantity in (SUCCESS, DISTANCE):
            one = mean_estimate(results.differences(scene, ours, other, quantity).values())
            if above(one) == "yes":
                said.append(f"{scene.label} {in_units(one, quantity)}")
                break
    holds: Holds = "yes" if len(said) >= least else "no"
    needs = list(product(SCENARIOS, [ours, other]))
    yield Comparison(f"{len(said)} of 6: {', '.join(said)}", holds, len(said), needs)


@judge
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


def either(*judges: Judge) -> Judge:
    """Whether one of several claims holds, and the one that says most for it."""
    order = ("yes", "undecided", "no")

    def finding(results: Results, kind: str) -> Finding:
        return min((one(results, kind) for one in judges), key=lambda one: order.index(one.holds))

    return finding
