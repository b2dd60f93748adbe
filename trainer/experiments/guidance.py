"""The fair table of human guidance: what each row costs the human, and what comes of it.

One page and one figure beside the records, made of what is there.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from statistics import median_low
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bridge.report import markdown_table
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import data, plan, report
from trainer.experiments.data import Line, Result, Results
from trainer.experiments.report import LEARNED, S_TO_LEARNED, S_TO_WELL, STEPS, Cell, spread, until
from trainer.experiments.run import Store
from trainer.learner.config import ALGORITHMS

TASKS = (*plan.SCENARIOS, *plan.FOREIGN)
PHIL = "phil_td3"
PAIRS = len(plan.SCENARIOS) * plan.DEFAULT_SEEDS
ENOUGH = 9  # Of these pairs: an equal row has so many by chance in one of 93 cases
OTHER_HUMANS = (Line(plan.HUMAN_MODEL, plan.MODEL), Line(plan.EXPERT, "slower"))
"""Other humans who drive by themselves."""
RETURN = "return over the expert's, nominal"


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
    yield from _what_the_rows_are()
    rows = [Line(row, plan.GOOD) for row in plan.ROWS]
    humans = [Line(plan.EXPERT, plan.GOOD), *OTHER_HUMANS]
    yield from (f"## With {plan.HUMANS[plan.GOOD].meaning}", "")
    yield from (f"![Success of the policy alone by what the human gave]({plan.GUIDANCE}.png)", "")
    yield from ("What a training cost:", "", *report.table(results, product(TASKS, rows), COSTS))
    yield from (
        "What came of it, the policy alone. Lost at the end: how far the validations of the last "
        f"{data.END_STEPS:,} steps are below the best one, which chance makes better, too.",
        "",
        *report.table(results, product(TASKS, [*rows, *humans]), outcomes(results), True),
    )
    yield from _place(results)
    yield from _forgiveness(results)


def _introduction(results: Results, store: Store) -> Iterator[str]:
    wanted = len(plan.units_of([plan.GUIDANCE], results.seeds))
    slow = store.plan.of("racetrack")
    budgets = ", ".join(f"{data.words(name)} {store.plan.steps[name]:,}" for name in TASKS)
    lines = [Line(row, human) for row in plan.ROWS for human in plan.HUMANS]
    yield from (
        "# The fair table of human guidance",
        "",
        f"`{report.COMMAND} {plan.GUIDANCE}` computes what is missing and writes this page. "
        f"{len(results.found)} of {wanted} trainings and tests are there.",
        "",
        "Every row has the same scenes, human and budget of environment steps "
        f"({budgets}). **Every human here is a script or a model of one: no person's cost is "
        "claimed.** Seconds are simulated ones in which the human drove. Watching is not in them: "
        "the human watches all the time, and beside the robot that asks for the first 500 steps.",
        "",
        "Numbers are means of the training seeds with their 95 % interval. One seed has none; a "
        "width of 0 says only that these few seeds agree. What it took to a level is the median "
        "of the seeds (of an even number the lower middle), the least and the most of them (∞: "
        "never), and how many get there. A level counts as reached in the first validation that "
        f"shows it. Validations are {store.plan.evaluate_every_steps} steps apart, of "
        f"{store.plan.evaluation_runs} drives (racetrack: {slow.evaluate_every_steps}, "
        f"{slow.evaluation_runs}): a finer difference in steps means nothing, and a policy that "
        "swings gets there by luck sooner. The actor that is tested is the best in them by "
        "success, then by the scene's return, for every row. Test drives: "
        f"{store.plan.test_runs} in each scene (racetrack: {slow.test_runs}). The two tasks that "
        "are not ours have three seeds, and neither variant nor dense traffic.",
        "",
        f"Computed in: {report.computed_in(results, lines, TASKS)}.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""


def _forgiveness(results: Results) -> Iterator[str]:
    yield from ("## Which row forgives which human", "", "In the left turn:", "")
    yield from (f"- {data.words(name)}: {human.meaning}" for name, human in plan.HUMANS.items())
    yield ""
    columns = {**COSTS, **outcomes(results)}
    found = {human: [results.of(plan.LEFT[0], Line(row, human)) for row in plan.HELPED]
             for human in plan.HUMANS}  # fmt: skip
    there = [human for human, each in found.items() if any(each)]
    for title in FORGIVENESS:
        cells = [[columns[title](its) if its else "–" for its in found[human]] for human in there]
        names = [Line(row).name for row in plan.HELPED]
        yield from markdown_table(
            (title, *map(data.words, there)), list(zip(names, *cells, strict=True))
        )
    if missing := [data.words(human) for human in plan.HUMANS if human not in there]:
        yield f"Not yet computed: {', '.join(missing)}."


FORGIVENESS = (
    "nominal, %", RETURN, S_TO_LEARNED, "failed episodes",
    "lost at the end, points",
)  # fmt: skip
"""What is told of every row beside every human."""


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
        "experiments-were-chosen-by). `trainer train --algorithm NAME` has them. What was chosen "
        "for a row of the paper's experiments is in this table alone, and wants `--set`.",
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
        f"{len(plan.HELPED) - 1} rows are compared in {len(TASKS)} tasks: one or two of so many "
        "intervals leave 0 out by chance.",
        "",
        "The rule, made before the trainings of this table and after those that tuned its rows: "
        "PHIL-TD3 stays what `trainer train` trains by default unless a row needs less of the "
        f"human to {LEARNED:.0%} in {ENOUGH} of the {PAIRS} pairs of the left turn and the "
        f"congestion ({plan.DEFAULT_SEEDS} seeds each), and its success is behind PHIL-TD3's in "
        "none of nominal, noise and variant there, by an interval below 0. Of several such rows it "
        "is the one with the least human seconds. However small a pair's difference is, it counts.",
        "",
    )
    rivals = [row for row in plan.HELPED if row != PHIL]
    lines = [Line(row, plan.GOOD) for row in rivals]
    yield from report.table(results, product(TASKS, lines), place_columns(results))
    judged = replace(results, seeds=plan.DEFAULT_SEEDS)
    fewest = min(len(_both_scenes(judged, row)) for row in rivals)
    if fewest < PAIRS:
        yield f"It cannot be judged yet: of one row {fewest} of {PAIRS} pairs are there."
    else:
        yield f"By that rule the default is {Line(best_by_rule(judged, rivals)).name}."
    yield ""


def best_by_rule(results: Results, rivals: Sequence[str]) -> str:
    """The row that is to be the default, by the rule on the page; ``results`` of five seeds."""

    def median_s(row: str) -> float:
        return median_low([own for own, _ in _both_scenes(results, row)])

    return min(
        (row for row in rivals if _takes_its_place(results, row)), key=median_s, default=PHIL
    )


def _takes_its_place(results: Results, row: str) -> bool:
    lines = Line(row, plan.GOOD), Line(PHIL, plan.GOOD)
    over = (results.differences(scene, *lines, data.SUCCESS) for scene in data.PAPER_SCENES)
    behind = any(data.mean_estimate(points.values()).high < 0.0 for points in over)
    return sum(own < its for own, its in _both_scenes(results, row)) >= ENOUGH and not behind


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
        return spread(less) if less else "–"

    def less_in(found: Sequence[Result]) -> str:
        pairs = _pairs(results, found)
        return f"{sum(own < other for own, other in pairs)} of {len(pairs)}"

    return {
        "success, nominal, points": _over(results, Line(PHIL, plan.GOOD), data.SUCCESS, 100.0, 1),
        S_TO_LEARNED: sooner,
        "less in": less_in,
    }


def _over(
    results: Results, other: Line, quantity: str, factor: float = 1.0, digits: int = 2
) -> Cell:
    """A quantity of the nominal drives less another line's."""

    def cell(found: Sequence[Result]) -> str:
        task, *line, _ = found[0].unit
        nominal = data.Scene(task, "nominal")
        over = results.differences(nominal, Line(*line), other, quantity).values()
        return data.mean_estimate(over).times(factor).text(digits)

    return cell


def _success(condition: str) -> Cell:
    def cell(found: Sequence[Result]) -> str:
        tested = [one for one in found if condition in one.record["tests"]]
        return data.mean_estimate(one.mean(condition, data.SUCCESS) for one in tested).as_share()

    return cell


def _estimate(number: Callable[[Result], float], digits: int = 0) -> Cell:
    """The mean of what is never below 0, and so is its interval."""

    def cell(found: Sequence[Result]) -> str:
        mean = data.mean_estimate(number(one) for one in found if one.unit.trained)
        return mean._replace(low=max(mean.low, 0.0) if mean.size > 1 else mean.low).text(digits)

    return cell


COSTS: Mapping[str, Cell] = {
    **{name: report.COSTS[name] for name in ("seeds", STEPS, S_TO_LEARNED, S_TO_WELL)},
    f"episodes to {LEARNED:.0%}": until(LEARNED, "episodes"),
    f"take-overs to {LEARNED:.0%}": until(LEARNED, "takeovers"),
    "human s in all": _estimate(lambda one: one.costs.human_s),
    "failed episodes": _estimate(lambda one: one.costs.failures),
}


def outcomes(results: Results) -> Mapping[str, Cell]:
    """The columns of what came of a training."""
    return {
        **{f"{name}, %": _success(name) for name in CONDITIONS},
        "lost at the end, points": _estimate(lambda one: 100.0 * one.unlearned, 1),
        RETURN: _over(results, Line(plan.EXPERT, plan.GOOD), data.REWARD),
    }


def draw(results: Results) -> Figure:
    """Success in validation by the human's seconds so far, a panel a task, with the good human."""
    tasks = [task for task in TASKS if any(results.of(task, Line(row, plan.GOOD)) for row in
                                           plan.ROWS)] or TASKS  # fmt: skip
    figure = Figure(figsize=(4.6 * len(tasks), 4.4), layout="constrained")
    panels = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for panel, task in zip(panels, tasks, strict=True):
        panel.set_title(data.words(task), fontsize=10)
        for place, row in enumerate(plan.ROWS):
            line = Line(row, plan.GOOD)
            found = [result for result in results.of(task, line) if result.unit.trained]
            if not found:
                continue
            given = np.mean([result.given() for result in found], axis=0)
            success = np.mean([r.curve(data.ALONE, data.SUCCESS) for r in found], axis=0)
            look = {"color": report.colour(line, place), "zorder": 3 + (row == PHIL)}
            panel.plot(given, success, "-o", ms=3, lw=1.3, label=Line(row).name, **look)
        panel.grid(alpha=0.3)
        # One row may need ten times as much as the others.
        panel.set_xscale("symlog", linthresh=10.0, subs=range(2, 10))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_xlabel("seconds that the human has driven", fontsize=9)
    shown = [zip(*panel.get_legend_handles_labels(), strict=True) for panel in figure.axes]
    rows = {label: handle for handle, label in chain(*shown)}
    if rows:
        figure.legend(rows.values(), rows.keys(), fontsize=8, ncols=5, loc="outside upper center")
    figure.supylabel("success of the policy alone, validation", fontsize=9)
    return figure
