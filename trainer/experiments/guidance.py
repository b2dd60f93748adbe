"""The fair table of human guidance: what each row costs the human, and what comes of it.

One page and one figure beside the records, made of what is there.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from statistics import mean, median_high
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bridge.report import markdown_table
from bridge.statistics import mean_estimate
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import data, plan, report
from trainer.experiments.data import Line, Result, Results
from trainer.experiments.report import LEARNED, S_TO_LEARNED, S_TO_WELL, STEPS, Cell, spread, until
from trainer.experiments.run import Store
from trainer.learner.config import ALGORITHMS
from trainer.training import metrics

TASKS = (*plan.SCENARIOS, *plan.FOREIGN)
PHIL = "phil_td3"
RIVALS = tuple(row for row in plan.HELPED if row != PHIL)
PAIRS = len(plan.SCENARIOS) * plan.DEFAULT_SEEDS
ENOUGH = 9  # Of these pairs: an equal row has so many by chance in one of 93 cases
MOST_EPISODES = 100  # In which a row is to learn
OWN = {plan.MODEL: Line(plan.HUMAN_MODEL, plan.MODEL), "slower": Line(plan.EXPERT, "slower")}
"""Humans who drive by themselves; the others are the expert, with a fault or without."""
RETURN = "return over the human's, nominal"


def write_guidance(store: Store, seeds: int) -> Path:
    """As ``report.write_report``: this page and its figure."""
    return report.write_report(store, seeds, plan.GUIDANCE, {plan.GUIDANCE: draw}, _page)


def write_typical(results: Path, humans: Path, seeds: int, path: Path) -> None:
    """Write the curves that a person's coach shows, of the records in both directories of results.

    Raises UserError: there is no record to make a curve of.
    """
    curves: dict[str, dict[str, Any]] = {}
    for name, work, units, human in (  # The good human goes before the paper's model of it.
        ("paper", plan.PLAN, "all", plan.NORMAL),
        (plan.GUIDANCE, plan.GUIDANCE_PLAN, plan.GUIDANCE, plan.GOOD),
    ):
        found = data.load(Store(work, results / name, Path(), humans), seeds, units)
        for environment, rows in typical_curves(found, human).items():
            curves.setdefault(environment, {}).update(rows)
    if not curves:
        raise UserError(f"there are no records of a guided training in {results}")
    write_atomic(path, (json.dumps(curves) + "\n").encode())


def typical_curves(results: Results, human: str) -> dict[str, dict[str, Any]]:
    """Environment -> algorithm -> the medians of its seeds with this human, at the grid's steps.

    ``points`` are pairs: the seconds that the human had driven, and the policy's success alone.
    """
    curves: dict[str, dict[str, Any]] = {}
    for scenario, environment, row in sorted({(u.scenario, u.environment, u.algorithm)
                                              for u in results.found}):  # fmt: skip
        found = [one for one in results.of(scenario, Line(row, human)) if one.unit.trained]
        if not any(one.costs.human_steps for one in found):
            continue
        given = np.median([one.given() for one in found], axis=0).round(1)
        alone = np.median([one.curve(data.ALONE, data.SUCCESS) for one in found], axis=0).round(3)
        curves.setdefault(environment, {})[row] = {
            "human": human, "seeds": len(found), "points": np.stack([given, alone], axis=1).tolist()
        }  # fmt: skip
    return curves


def _page(results: Results, store: Store) -> Iterator[str]:
    yield from _introduction(results, store)
    yield from _in_short(results)
    yield from _forgiveness(results)
    yield from _place(results)
    yield from _what_the_rows_are()
    yield from _all_numbers(results, store)


def _introduction(results: Results, store: Store) -> Iterator[str]:
    wanted = len(plan.units_of([plan.GUIDANCE], results.seeds))
    budgets = ", ".join(f"{data.words(name)} {store.plan.steps[name]:,}" for name in TASKS)
    yield from (
        "# The fair table of human guidance",
        "",
        "What does each way of learning from a human cost the human, and what comes of it? Every "
        f"row has the same scenes, human and budget of environment steps ({budgets}); [what each "
        "learns from](#what-the-rows-are). Left turn and congestion are ours, hill is a car that "
        "is too weak for its hill, racetrack is highway-env's. **Every human here is a script or "
        "a model of one: no person's cost is claimed.** Seconds are simulated ones in which the "
        "human drove. Watching is not in them: the human watches all the time, with *the robot "
        "asks* the first 500 steps.",
        "",
        f"`{report.COMMAND} {plan.GUIDANCE}` computes what is missing and writes this page. "
        f"{len(results.found)} of {wanted} trainings and tests are there.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""


def _in_short(results: Results) -> Iterator[str]:
    """The table, what it says in words, and the figure."""
    yield from (
        f"## In short: with {plan.HUMANS[plan.GOOD].meaning}",
        "",
        f"Seconds that the human drove until the policy alone reached {LEARNED:.0%} of its "
        "validation drives (median of the seeds, least and most; ∞: never), then success in the "
        "nominal test drives (mean of the seeds), and in how many of the pairs of seeds in our two "
        "scenes it took less of the human than with PHIL-TD3.",
        "",
    )
    cells = {**{f"s, {data.words(task)}": (task, until(LEARNED, "human_s")) for task in TASKS},
             **{f"%, {data.words(task)}": (task, lambda its: f"{_nominal(its):.0f}")
                for task in TASKS}}  # fmt: skip
    rows = []
    for row in plan.ROWS:
        found = {task: results.of(task, Line(row, plan.GOOD)) for task in TASKS}
        told = (cell(found[task]) if found[task] else "–" for task, cell in cells.values())
        less = _less(_both_scenes(results, row)) if row in RIVALS else "–"
        rows.append((Line(row).name, *told, less))
    yield from markdown_table(("", *cells, "pairs with less than PHIL-TD3"), rows)
    late = [row for row in plan.ROWS if not learns(results, row)]
    names = ", ".join(Line(row).name for row in late)
    yield from (
        f"- **Who learns.** In the left turn or in the congestion, {LEARNED:.0%} within "
        f"{MOST_EPISODES} episodes in every seed: "
        + (f"all rows but {names} ([why](../README.md#the-fair-table))." if late else "all rows."),
        f"- **The default.** {_verdict(results)} [The rule](#phil-td3s-place) wants less of "
        f"the human in {ENOUGH} of {PAIRS} pairs.",
        forgiven(results),
        "",
        f"![What each row cost the human, and what came of it]({plan.GUIDANCE}.png)",
        "",
        "A dot is a seed, the bar their middle (above) or mean (below), red is PHIL-TD3.",
        "",
    )


def _nominal(found: Sequence[Result]) -> float:
    return 100.0 * float(np.mean([one.mean("nominal", data.SUCCESS) for one in found]))


def _fewer(pairs: Sequence[tuple[float, float]]) -> int:
    """In how many pairs a row needs less of the human than PHIL-TD3."""
    return sum(own < phil for own, phil in pairs)


def _less(pairs: Sequence[tuple[float, float]]) -> str:
    return f"{_fewer(pairs)} of {len(pairs)}"


def learns(results: Results, row: str) -> bool:
    """Whether it gets there in good time in every seed of one of our scenes."""

    def soon(one: Result) -> bool:
        cost = one.until(LEARNED)
        return cost is not None and cost.episodes <= MOST_EPISODES

    each = (results.of(task, Line(row, plan.GOOD)) for task in plan.SCENARIOS)
    return any(found and all(map(soon, found)) for found in each)


def forgiven(results: Results) -> str:
    """Which row forgives which human, in a sentence."""
    good, less = [], []
    for row in plan.HELPED:
        beside = {human: its for human in plan.HUMANS
                  if (its := results.of(plan.LEFT[0], Line(row, human)))}  # fmt: skip
        shares = {human: _nominal(its) for human, its in beside.items()}
        low = [f"{data.words(human)} {share:.1f}" for human, share in shares.items()
               if share < 100.0 * LEARNED]  # fmt: skip
        if low:
            less.append(f"{Line(row).name} ({', '.join(low)})")
        elif shares:
            good.append(Line(row).name)
    return (
        f"- **Who forgives.** At least {LEARNED:.0%} success, on average, beside each of [the "
        f"humans in the left turn](#which-row-forgives-which-human): {', '.join(good) or 'no row'}."
        + (f" Less beside some: {'; '.join(less)}." if less else "")
    )


def _forgiveness(results: Results) -> Iterator[str]:
    yield from ("## Which row forgives which human", "", "In the left turn, the humans are:")
    yield ""
    for name, human in plan.HUMANS.items():
        counts = [len(its) for its in _beside(results, name)] or [0]
        seeds = " to ".join(map(str, sorted({min(counts), max(counts)})))
        yield f"- {data.words(name)}: {human.meaning} ({seeds} seeds)"
    yield from ("", *_beside_each(results, "success, nominal, %", _success("nominal")))


def _beside(results: Results, human: str) -> list[list[Result]]:
    """The trainings of every row that this human guided, where there are some."""
    found = [results.of(plan.LEFT[0], Line(row, human)) for row in plan.HELPED]
    return found if any(found) else []


def _beside_each(results: Results, title: str, cell: Cell) -> Iterator[str]:
    """A row for each algorithm, a column for each human."""
    columns = {human: its for human in plan.HUMANS if (its := _beside(results, human))}
    cells = ([cell(its) if its else "–" for its in each] for each in columns.values())
    names = (Line(row).name for row in plan.HELPED)
    return markdown_table((title, *map(data.words, columns)), list(zip(names, *cells, strict=True)))


def _all_numbers(results: Results, store: Store) -> Iterator[str]:
    slow = store.plan.of("racetrack")
    rows = [Line(row, plan.GOOD) for row in plan.ROWS]
    humans = [Line(plan.EXPERT, plan.GOOD), *OWN.values()]
    lines = [Line(row, human) for row in plan.ROWS for human in plan.HUMANS]
    yield from (
        "## All numbers",
        "",
        "Numbers are means of the training seeds with their 95 % interval. One seed has none; a "
        "width of 0 says only that these few seeds agree. What it took to a level is the median "
        "of the seeds (of an even number the upper middle), the least and the most of them (∞: "
        "never), and how many get there if not all do; *never* if none does. A level counts as "
        "reached in the first validation that shows it. "
        f"Validations are {store.plan.evaluate_every_steps} steps apart, "
        f"of {store.plan.evaluation_runs} drives (racetrack: {slow.evaluate_every_steps}, "
        f"{slow.evaluation_runs}): a finer difference in steps means nothing, and a policy that "
        "swings gets there by luck sooner. The actor that is tested is the best in them by "
        "success, then by the scene's return, for every row. Test drives: "
        f"{store.plan.test_runs} in each scene (racetrack: {slow.test_runs}). A human step takes "
        "0.1 s (hill: 1/30, racetrack: 0.2). The two tasks that are not ours have three seeds, "
        "and neither variant nor dense traffic.",
        "",
        "The trainings' arithmetic (the same settings, other bits): "
        f"{report.computed_in(results, lines, TASKS)}.",
        "",
        f"What a training cost, with {plan.HUMANS[plan.GOOD].meaning}:",
        "",
        *report.table(results, product(TASKS, rows), COSTS),
        "What came of it, the policy alone. Lost at the end: how far the validations of the last "
        f"{data.END_STEPS:,} steps are below the best one; the best of many is partly luck. The "
        "last column is the return less that of the human; of a human itself, less the expert's.",
        "",
        *report.table(results, product(TASKS, [*rows, *humans]), outcomes(results), True),
        "Beside each human in the left turn. The paper's model and the slower human drive by "
        "themselves, and a row's return is held against theirs; the others are the expert with a "
        "fault, and it is held against the expert's.",
        "",
    )
    columns = {**COSTS, **outcomes(results)}
    for title in (S_TO_LEARNED, "failed episodes", "lost at the end, points", RETURN):
        yield from _beside_each(results, title, columns[title])


def _what_the_rows_are() -> Iterator[str]:
    def named(settings: Mapping[str, Any]) -> str:
        return ", ".join(f"`{name}={value}`" for name, value in settings.items())

    yield from (
        "## What the rows are",
        "",
        "All share one learner; [what each learns from]"
        "(../../trainer/README.md#the-fair-table-of-human-guidance). A row has settings of its own "
        "where ours would not fit what it learns from, or where three trainings of each row, on a "
        "seed that is not in the table, [chose others](../README.md#what-the-settings-of-the-"
        "experiments-were-chosen-by). `trainer train --algorithm NAME` has them. Those of the last "
        "column are used in this table only: `trainer train` needs `--set NAME=VALUE`.",
        "",
    )
    yield from markdown_table(
        ("", "`NAME`", "settings of its own", "in this table alone"),
        [
            (Line(row).name, f"`{row}`", named(ALGORITHMS[row].settings),
             named(plan.TUNED.get(row, {})))
            for row in plan.ROWS
        ],
    )  # fmt: skip


def _place(results: Results) -> Iterator[str]:
    yield from (
        "## PHIL-TD3's place",
        "",
        "With the same human: each row less PHIL-TD3, pair by pair of seeds; of the human's "
        "seconds the median, the least and the most. ∞: the row never gets there; -∞: PHIL-TD3 "
        "never does; a pair in which neither does counts as 0. "
        f"{len(RIVALS)} rows are compared in {len(TASKS)} tasks: one or two of so many "
        "intervals leave 0 out by chance.",
        "",
        "The rule, made before the trainings of this table and after those that tuned its rows: "
        "PHIL-TD3 stays what `trainer train` trains by default unless a row needs less of the "
        f"human to {LEARNED:.0%} in {ENOUGH} of the {PAIRS} pairs of the left turn and the "
        f"congestion ({plan.DEFAULT_SEEDS} seeds each), and the row's success is behind "
        "PHIL-TD3's in none of nominal, noise and variant there, by an interval below 0. Of "
        "several such rows it is the one with the least human seconds (this sentence came after "
        "the first 68 units, and has decided nothing). However small a pair's difference is, it "
        "counts.",
        "",
    )
    lines = [Line(row, plan.GOOD) for row in RIVALS]
    yield from report.table(results, product(TASKS, lines), place_columns(results))
    yield from (_verdict(results), "")


def _verdict(results: Results) -> str:
    judged = replace(results, seeds=plan.DEFAULT_SEEDS)
    fewest = min(len(_both_scenes(judged, row)) for row in RIVALS)
    if fewest < PAIRS:
        return f"The default cannot be judged yet: of one row {fewest} of {PAIRS} pairs are there."
    return f"By the rule the default is {Line(best_by_rule(judged, RIVALS)).name}."


def best_by_rule(results: Results, rivals: Sequence[str]) -> str:
    """The row that is to be the default, by the rule on the page; ``results`` of five seeds."""

    def median_s(row: str) -> float:
        return median_high([own for own, _ in _both_scenes(results, row)])

    return min(
        (row for row in rivals if _takes_its_place(results, row)), key=median_s, default=PHIL
    )


def _takes_its_place(results: Results, row: str) -> bool:
    lines = Line(row, plan.GOOD), Line(PHIL, plan.GOOD)
    over = (results.differences(scene, *lines, data.SUCCESS) for scene in data.PAPER_SCENES)
    behind = any(mean_estimate(points.values()).high < 0.0 for points in over)
    return _fewer(_both_scenes(results, row)) >= ENOUGH and not behind


def _both_scenes(results: Results, row: str) -> list[tuple[float, float]]:
    found = (results.of(task, Line(row, plan.GOOD)) for task in plan.SCENARIOS)
    return [pair for its in found for pair in _pairs(results, its)]


def _pairs(results: Results, found: Sequence[Result]) -> list[tuple[float, float]]:
    """The human's seconds until a row and PHIL-TD3 had learned, seed by seed."""
    task = found[0].unit.scenario if found else ""
    seconds, phil = (
        {one.unit.seed: cost.human_s if (cost := one.until(LEARNED)) else np.inf for one in each}
        for each in (found, results.of(task, Line(PHIL, plan.GOOD)))
    )
    return [(seconds[seed], phil[seed]) for seed in seconds.keys() & phil.keys()]


def place_columns(results: Results) -> Mapping[str, Cell]:
    """A row less PHIL-TD3: success, the human's seconds, and in how many pairs these are fewer."""

    def sooner(found: Sequence[Result]) -> str:
        pairs = _pairs(results, found)
        less = [own - its if own != its else 0.0 for own, its in pairs]
        return spread(less) if np.isfinite(pairs).any() else "–"

    return {
        "success, nominal, points": _over(results, Line(PHIL, plan.GOOD), data.SUCCESS, 100.0, 1),
        S_TO_LEARNED: sooner,
        "less in": lambda found: _less(_pairs(results, found)),
    }


def _over(
    results: Results, other: Line, quantity: str, factor: float = 1.0, digits: int = 2
) -> Cell:
    """A quantity of the nominal drives less another line's."""

    def cell(found: Sequence[Result]) -> str:
        task, *line, _ = found[0].unit
        nominal = data.Scene(task, "nominal")
        over = results.differences(nominal, Line(*line), other, quantity).values()
        return mean_estimate(over).times(factor).text(digits)

    return cell


def _success(condition: str) -> Cell:
    def cell(found: Sequence[Result]) -> str:
        tested = [one for one in found if condition in one.record["tests"]]
        return mean_estimate(one.mean(condition, data.SUCCESS) for one in tested).as_share()

    return cell


def _estimate(number: Callable[[Result], float], digits: int = 0) -> Cell:
    """The mean of what is never below 0, and so is its interval."""

    def cell(found: Sequence[Result]) -> str:
        its = mean_estimate(number(one) for one in found if one.unit.trained)
        return its._replace(low=max(its.low, 0.0) if its.size > 1 else its.low).text(digits)

    return cell


COSTS: Mapping[str, Cell] = {
    **{name: report.COSTS[name] for name in ("seeds", STEPS, S_TO_LEARNED, S_TO_WELL)},
    f"episodes to {LEARNED:.0%}": until(LEARNED, "episodes"),
    **{f"take-overs to {level:.0%}": until(level, "takeovers") for level in metrics.LEARNED},
    f"failed episodes to {LEARNED:.0%}": until(LEARNED, "failures"),
    "human s in all": _estimate(lambda one: one.costs.human_s),
    "failed episodes": _estimate(lambda one: one.costs.failures),
}


def outcomes(results: Results) -> Mapping[str, Cell]:
    """The columns of what came of a training."""
    return {
        **{f"{name}, %": _success(name) for name in CONDITIONS},
        "lost at the end, points": _estimate(lambda one: 100.0 * one.unlearned, 1),
        RETURN: lambda found: _over(results, _held_against(found[0].unit), data.REWARD)(found),
    }


def _held_against(unit: plan.Unit) -> Line:
    expert = Line(plan.EXPERT, plan.GOOD)
    return OWN.get(unit.setting, expert) if unit.trained else expert


def draw(results: Results) -> Figure:
    """A panel a task, a dot a seed: the human's seconds until a row learned, and its success."""
    figure = Figure(figsize=(3.3 * len(TASKS) + 1.5, 7.0), layout="constrained")
    panels = figure.subplots(2, len(TASKS), sharey=True)
    heights = -np.arange(len(plan.ROWS))
    for (above, below), task in zip(panels.T, TASKS, strict=True):
        costs: list[list[float]] = []
        shares: list[list[float]] = []
        for row in plan.ROWS:
            found = results.of(task, Line(row, plan.GOOD))
            its = (one.until(LEARNED) for one in found if row in plan.HELPED)
            costs.append([cost.human_s if cost else np.inf for cost in its])
            shares.append([100.0 * one.mean("nominal", data.SUCCESS) for one in found])
        most = max((s for s in chain(*costs) if np.isfinite(s)), default=1.0)
        never = 1.15 * most
        _dots(above, heights, [[min(s, never) for s in each] for each in costs], median_high)
        for row, height in zip(plan.ROWS, heights, strict=True):
            if row not in plan.HELPED:
                above.text(0.02 * most, height, "no human", va="center", fontsize=8)
        above.axvline(1.08 * most, color="0.6", lw=0.8, ls=":")
        above.text(never, 0.8, "never", ha="center", fontsize=8)
        above.set(title=data.words(task), xlim=(0.0, 1.25 * most))
        above.set_xticks([tick for tick in above.get_xticks() if tick <= most])
        above.set_xlabel(f"seconds of the human until {LEARNED:.0%} alone", fontsize=9)
        _dots(below, heights, shares, mean)
        below.set(xlim=(-4.0, 104.0))
        below.set_xlabel("success, nominal tests, %", fontsize=9)
    for panel in panels[:, 0]:
        panel.set_yticks(heights, [Line(row).name for row in plan.ROWS], fontsize=8)
        panel.set_ylim(heights[-1] - 0.6, 1.6)
    return figure


def _dots(
    panel: Axes,
    heights: NDArray[np.int64],
    rows: Sequence[Sequence[float]],
    middle: Callable[[Sequence[float]], float],
) -> None:
    """A dot for each number of a row, beside one another, and a bar for their middle."""
    panel.grid(axis="x", alpha=0.3)
    for row, height, numbers in zip(plan.ROWS, heights, rows, strict=True):
        colour = "C3" if row == PHIL else "C0"
        panel.axhline(height, color="0.93", lw=0.8, zorder=0)
        if numbers:  # None where a row has no human
            places = height + np.linspace(0.2, -0.2, len(numbers))
            panel.plot(numbers, places, "o", ms=4, alpha=0.55, mew=0, color=colour)
            panel.plot([middle(numbers)] * 2, [height - 0.35, height + 0.35], lw=2, color=colour)
