"""Judges: what a claim comes to, measured on the records.

A claim is about algorithms, so the numbers compared are one a training seed, paired by seed. It
holds, or does not, where a 95 % interval lies on one side; else it is undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise, permutations, product
from typing import NamedTuple

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
    estimate: Estimate = NOTHING
    """The comparison that decides."""


def name_of(line: Line) -> str:
    """An algorithm in words, with its setting where that is not the normal one."""
    setting = "" if line.setting == NORMAL else f" ({line.setting.replace('_', ' ')})"
    return LABELS[line.algorithm] + setting


def _scenario(place: Place) -> str:
    return place if isinstance(place, str) else place.scenario


def _place(place: Place) -> str:
    return place.replace("_", " ") if isinstance(place, str) else place.label


def _decided(
    found: Mapping[str, Estimate],
    answers: Mapping[str, Holds],
    complete: bool,
    show: Callable[[Estimate, str], str],
    sign: float = 1.0,
) -> Finding:
    """All comparisons together, shown by the worst one of those that decide.

    Undecided wherever trainings are missing. With sign 0 the largest difference is the worst.
    """
    holds = all_of(list(answers.values()))
    candidates = [name for name in found if answers[name] == holds and found[name].size]
    if not candidates:
        return Finding("undecided", "not measured")
    worst = min(candidates, key=lambda name: sign * found[name].value or -abs(found[name].value))
    return Finding(holds if complete else "undecided", show(found[worst], worst), found[worst])


def _complete(results: Results, places: Sequence[Place], lines: Sequence[Line]) -> bool:
    return all(results.complete(_scenario(place), line) for place in places for line in lines)


def difference(first: BySeed, second: BySeed) -> Estimate:
    """Mean of first minus second over the seeds that both have."""
    return mean_estimate(first[seed] - second[seed] for seed in first if seed in second)


def in_units(one: Estimate, quantity: str) -> str:
    """A difference of a quantity in words."""
    factor, digits, unit = UNITS[quantity]
    return one.times(factor).text(digits) + unit


def _percent(one: Estimate, name: str) -> str:
    return f"{one.times(100.0).text(1)} %: {name}"


def ahead(
    results: Results,
    kind: str,
    places: Sequence[Place],
    ours: Sequence[Line],
    others: Sequence[Line],
    quantities: Sequence[str] = (DISTANCE,),
    sign: float = 1.0,
) -> Finding:
    """Whether each of ours is above (sign -1: below) each of the others in every place; with sign
    0, whether it is on their level.
    """
    found, answers, names = {}, {}, {}
    for place, quantity, first, second in product(places, quantities, ours, others):
        name = f"{name_of(first)} over {name_of(second)}, {_place(place)}"
        name += f", {WORDS.get(quantity, quantity)}" if len(quantities) > 1 else ""
        names[name] = quantity
        if isinstance(place, Scene):
            own = results.tested(place, first, quantity)
            one = mean_estimate(results.differences(place, first, second, quantity).values())
        else:
            own = results.ends(place, first, kind, quantity)
            one = difference(own, results.ends(place, second, kind, quantity))
        scale = 1.0 if quantity == SUCCESS else abs(mean_estimate(own.values()).value)
        found[name] = one
        answers[name] = above(one.times(sign)) if sign else within(one, SAME_LEVEL * scale)

    complete = _complete(results, places, [*ours, *others])
    return _decided(
        found, answers, complete, lambda one, name: f"{in_units(one, names[name])}: {name}", sign
    )


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
) -> Finding:
    """Whether each of ours is so many times as soon as each of the others, or as the best of them.

    With ``by_mean`` the ratio itself decides, not its interval; a lower bound of it only says yes.
    """
    found, answers, said = {}, {}, {}
    for place, quantity in product(places, quantities):
        rivals = others
        if best:
            rivals = [best_of(results, place, others, kind, quantity)]
        for first, second in product(ours, rivals):
            name = f"{name_of(first)} before {name_of(second)}, {_place(place)}"
            name += f", {WORDS[quantity]}" if len(quantities) > 1 else ""
            own, other = results.of(place, first), results.of(place, second)
            one, said[name] = sooner_by(own, other, kind, quantity, common, least)
            found[name], answers[name] = one, above(one, times)
            if by_mean and one.size:
                bound: Holds = "undecided" if said[name].endswith("never steps") else "no"
                answers[name] = "yes" if one.value >= times else bound
    complete = _complete(results, places, [*ours, *others])
    return _decided(
        found, answers, complete, lambda one, name: f"{one.text(1)} times, {said[name]}: {name}"
    )


def kept_shares(results: Results, scenario: str, line: Line, kind: str) -> BySeed:
    """Seed -> its part in the ratio of the final distances, one frame over two.

    The mean of these is the ratio of the means, and their spread that ratio's to first order. A
    mean of the seeds' own ratios would be ruled by whichever learned next to nothing with two.
    """
    two = results.ends(scenario, line, kind, DISTANCE)
    one = results.ends(scenario, Line(line.algorithm, ONE_FRAME), kind, DISTANCE)
    seeds = sorted(two.keys() & one.keys())
    mean = float(np.mean([two[seed] for seed in seeds])) if seeds else 0.0
    if not mean:
        return {}
    ratio = float(np.mean([one[seed] for seed in seeds])) / mean
    return {seed: ratio + (one[seed] - ratio * two[seed]) / mean for seed in seeds}


def kept(
    results: Results,
    kind: str,
    places: Sequence[str],
    ours: Sequence[Line],
    others: Sequence[Line] = (),
) -> Finding:
    """Whether each of ours keeps more of its distance with one frame than each of the others, or,
    without others, whether each of ours loses some.
    """
    found = {}
    for place in places:
        shares = {line: kept_shares(results, place, line, kind) for line in (*ours, *others)}
        for first in ours:
            if not others:
                lost = mean_estimate(1.0 - share for share in shares[first].values())
                found[f"lost by {name_of(first)}, {_place(place)}"] = lost
            for second in others:
                name = f"{name_of(first)} over {name_of(second)}, {_place(place)}"
                found[name] = difference(shares[first], shares[second])
    answers = {name: above(one) for name, one in found.items()}
    lines = [*ours, *others]
    complete = _complete(
        results, places, [*lines, *(Line(line.algorithm, ONE_FRAME) for line in lines)]
    )
    return _decided(found, answers, complete, _percent)


def same_ranking(
    results: Results, kind: str, places: Sequence[str], lines: Sequence[Line]
) -> Finding:
    """Whether the lines end in one order with two frames and with one.

    Yes where every neighbour is ahead in both, no where two have changed places for sure.
    """
    answers: list[Holds] = []
    said = []
    for place in places:
        both = []
        for setting in (NORMAL, ONE_FRAME):
            chosen = [Line(line.algorithm, setting) for line in lines]
            both.append([results.ends(place, line, kind, DISTANCE) for line in chosen])
        means = [[mean_estimate(end.values()).value for end in ends] for ends in both]
        orders = [sorted(range(len(lines)), key=lambda i: -each[i]) for each in means]
        swapped = any(
            above(difference(both[0][i], both[0][j])) == "yes"
            and above(difference(both[1][i], both[1][j])) == "no"
            for i, j in permutations(range(len(lines)), 2)
        )
        apart = all(
            above(difference(ends[i], ends[j])) == "yes"
            for ends, order in zip(both, orders, strict=True)
            for i, j in pairwise(order)
        )
        same = apart and orders[0] == orders[1]
        answers.append("no" if swapped else "yes" if same else "undecided")
        shown = [" > ".join(name_of(lines[i]) for i in order) for order in orders]
        said.append(f"{_place(place)}: two frames {shown[0]}, one {shown[1]}")
    settings = [Line(line.algorithm, setting) for line in lines for setting in (NORMAL, ONE_FRAME)]
    complete = _complete(results, places, settings)
    return Finding(all_of(answers) if complete else "undecided",
                   "; ".join(said) if complete else "not measured")  # fmt: skip


def dropped(results: Results, kind: str, places: Sequence[str], ours: Sequence[Line]) -> Finding:
    """Whether the variant scene costs each of ours success."""
    found = {}
    for place, line in product(places, ours):
        nominal, variant = (
            results.tested(Scene(place, condition), line, SUCCESS)
            for condition in ("nominal", "variant")
        )
        found[f"lost by {name_of(line)}, {_place(place)}"] = difference(nominal, variant)
    answers = {name: above(one) for name, one in found.items()}
    return _decided(found, answers, _complete(results, places, ours), _percent)


def changes(
    results: Results, line: Line, setting: str, scenes: Sequence[Scene] = PAPER_SCENES
) -> BySeed:
    """Seed -> relative change of the surviving distance under poor guidance, over the scenes."""
    by_seed: dict[int, list[float]] = {}
    for scene in scenes:
        good = results.tested(scene, line, DISTANCE)
        poor = results.tested(scene, Line(line.algorithm, setting), DISTANCE)
        for seed in good.keys() & poor.keys():
            by_seed.setdefault(seed, []).append(poor[seed] / good[seed] - 1.0)
    return {seed: float(np.mean(values)) for seed, values in by_seed.items()}


def changed(
    results: Results,
    kind: str,
    line: Line,
    judged: Callable[[Estimate], Holds],
    than: Line | None = None,
    each_scene: bool = False,
) -> Finding:
    """How random poor guidance changes a line's surviving distance, or more than another's."""
    groups = [(scene,) for scene in PAPER_SCENES] if each_scene else [PAPER_SCENES]
    found = {}
    for scenes in groups:
        own = changes(results, line, RANDOM, scenes)
        name = name_of(line) + (f" against {name_of(than)}" if than else "")
        name += f", {scenes[0].label}" if each_scene else ""
        found[name] = (
            difference(own, changes(results, than, RANDOM, scenes))
            if than
            else mean_estimate(own.values())
        )
    lines = [line, *([than] if than else [])]
    poor = [Line(one.algorithm, RANDOM) for one in lines]
    answers = {name: judged(one) for name, one in found.items()}
    return _decided(found, answers, _complete(results, SCENARIOS, [*lines, *poor]), _percent)


def success_bar(results: Results, kind: str, scene: Scene, line: Line, least: float) -> Finding:
    """Whether the mean of the seeds' success is at least so much."""
    by_seed = results.tested(scene, line, SUCCESS)
    found = mean_estimate(by_seed.values())
    if not found.size:
        return Finding("undecided", "not measured")
    drives = [r.reached(scene.condition) for r in results.of(scene.scenario, line)]
    paper, others = (
        [float(one.mean()) for one in part if len(one)]
        for part in ([d[:PAPER_TESTS] for d in drives], [d[PAPER_TESTS:] for d in drives])
    )
    shown = f"{found.times(100.0).text(1)} %; the paper's seeds {100 * np.mean(paper):.1f} %"
    shown += f", others {100 * np.mean(others):.1f} %" if others else ""
    holds: Holds = "yes" if found.value >= least - 1e-9 else "no"
    complete = results.complete(scene.scenario, line)
    return Finding(holds if complete else "undecided", shown, found)


def ahead_in(results: Results, kind: str, least: int) -> Finding:
    """Whether PHIL-TD3 is ahead of its human in success or distance in so many scenes."""
    said = []
    for scene in PAPER_SCENES:
        for quantity in (SUCCESS, DISTANCE):
            found = mean_estimate(results.differences(scene, PHIL, HUMAN, quantity).values())
            if above(found) == "yes":
                said.append(f"{scene.label} {in_units(found, quantity)}")
                break
    complete = _complete(results, SCENARIOS, [PHIL, HUMAN])
    holds: Holds = "yes" if len(said) >= least else "no"
    return Finding(holds if complete else "undecided", f"{len(said)} of 6: {', '.join(said)}")


UNLEARNED = 0.02
LATE = 3
"""Validations whose mean counts: a single one of 50 drives is off by some points."""


def unlearned(results: Results, kind: str, place: str, line: Line) -> Finding:
    """Whether the policy alone ends at most 2 points below its best, as a mean of the seeds."""
    lost = {}
    for result in results.of(place, line):
        values = np.asarray(result.record["validation"][SUCCESS], float)
        width = min(LATE, len(values))
        means = np.convolve(values, np.full(width, 1.0 / width), "valid")
        lost[result.unit.seed] = float(means.max() - means[-1])
    found = mean_estimate(lost.values())
    holds: Holds = "yes" if found.value <= UNLEARNED else "no"
    complete = results.complete(place, line)
    shown = f"{found.times(100.0).text(1)} points"
    return Finding(holds if complete else "undecided", shown, found)


def either(results: Results, kind: str, judges: Sequence[Callable[..., Finding]]) -> Finding:
    """Whether one of several claims holds, and the one that says most for it."""
    findings = [judge(results, kind) for judge in judges]
    for holds in ("yes", "undecided"):
        for finding in findings:
            if finding.holds == holds:
                return finding
    return findings[0]
