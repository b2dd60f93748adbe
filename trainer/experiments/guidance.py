"""The fair table of human guidance: what each row costs the human, and what comes of it.

One page and one figure beside the records, made of what is there.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bridge.report import markdown_table
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import data, plan, report
from trainer.experiments.data import Line, Result, Results
from trainer.experiments.report import COMMAND, LEARNED, Cell, colour, computed_in, spread, until
from trainer.experiments.run import Store
from trainer.learner.config import ALGORITHMS

TASKS = (*plan.SCENARIOS, *plan.FOREIGN)
PHIL = "phil_td3"
ENOUGH = 9  # Pairs of seeds, of ten: by chance one of 93 rivals that are equals has so many
S_TO_LEARNED = f"human s to {LEARNED:.0%}"
OTHER_HUMANS = (Line(plan.HUMAN_MODEL, plan.MODEL), Line(plan.EXPERT, "slower"))
"""Other humans who drive by themselves."""


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
    wanted = len(plan.units_of([plan.GUIDANCE], results.seeds))
    slow = store.plan.of("racetrack")
    budgets = ", ".join(f"{data.words(name)} {store.plan.steps[name]:,}" for name in TASKS)
    lines = [Line(row, human) for row in plan.ROWS for human in plan.HUMANS]
    yield from (
        "# The fair table of human guidance",
        "",
        f"`{COMMAND} {plan.GUIDANCE}` computes what is missing and writes this page. "
        f"{len(results.found)} of {wanted} trainings and tests are there.",
        "",
        "Every row has the same scenes, human and budget of environment steps "
        f"({budgets}). **Every human here is a script or a model of one: no person's cost is "
        "claimed.** Seconds are simulated ones in which the human drove. It watches all the time, "
        "except beside the robot that asks.",
        "",
        "Numbers are means of the training seeds with their 95 % interval, of no width where all "
        "seeds agree. What it took to a level is the median of the seeds, the least and the most "
        "of them (∞: never), and how many get there. A level counts as reached in the first "
        f"validation that shows it. Validations are {store.plan.evaluate_every_steps} steps "
        f"apart, of {store.plan.evaluation_runs} drives (racetrack: {slow.evaluate_every_steps}, "
        f"{slow.evaluation_runs}): no finer difference counts, and a policy that swings gets "
        "there by luck sooner. The actor that is tested is the best in them by success, then by "
        "the scene's return, for every row. Test drives: "
        f"{store.plan.test_runs} in each scene (racetrack: {slow.test_runs}). The two tasks that "
        "are not ours have three seeds, and no variant.",
        "",
        f"Computed in: {computed_in(results, lines, TASKS)}.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""
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
    yield from ("## Which row forgives which human", "", "In the left turn:", "")
    yield from (f"- {data.words(name)}: {human.meaning}" for name, human in plan.HUMANS.items())
    yield ""
    columns = {**COSTS, **outcomes(results)}
    found = {row: [results.of(plan.LEFT[0], Line(row, human)) for human in plan.HUMANS]
             for row in plan.HELPED}  # fmt: skip
    for title in FORGIVENESS:
        yield from markdown_table(
            (title, *map(data.words, plan.HUMANS)),
            [(Line(row).name, *(columns[title](its) if its else "–" for its in each))
             for row, each in found.items()],
        )  # fmt: skip


FORGIVENESS = (
    "nominal, %", "return over the expert's", S_TO_LEARNED, "failed episodes",
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
        f"never does; 0: neither. {len(plan.HELPED) - 1} rows are compared in {len(TASKS)} tasks: "
        "one or two of so many intervals leave 0 out by chance.",
        "",
        "The rule, made before there was a record: PHIL-TD3 stays what `trainer train` trains by "
        f"default unless a row needs less of the human to {LEARNED:.0%} in {ENOUGH} of the "
        f"{len(plan.SCENARIOS) * plan.DEFAULT_SEEDS} pairs of the left turn and the congestion, "
        "and is behind in none of their six scenes, by intervals that leave 0 out.",
        "",
    )
    rivals = [row for row in plan.HELPED if row != PHIL]
    lines = [Line(row, plan.GOOD) for row in rivals]
    yield from report.table(results, product(TASKS, lines), place_columns(results))
    better = [Line(row).name for row in rivals if takes_its_place(results, row)]
    there = [len(results.of(*place)) for place in product(plan.SCENARIOS, lines)]
    so_far = "" if min(there) == plan.DEFAULT_SEEDS else ", of what is there so far"
    yield f"By that rule {', '.join(better) or 'no row'} takes its place{so_far}."
    yield ""


def takes_its_place(results: Results, row: str) -> bool:
    """Whether a row is to be the default instead of PHIL-TD3, by the rule on the page."""
    pairs = [its for task in plan.SCENARIOS
             for its in _pairs(results, results.of(task, Line(row, plan.GOOD)))]  # fmt: skip
    lines = Line(row, plan.GOOD), Line(PHIL, plan.GOOD)
    over = (results.differences(scene, *lines, data.SUCCESS) for scene in data.PAPER_SCENES)
    behind = any(data.mean_estimate(points.values()).high < 0.0 for points in over)
    return sum(own < other for own, other in pairs) >= ENOUGH and not behind


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
        return spread([own - other if own != other else 0.0 for own, other in pairs] or [np.nan])

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
    return lambda found: data.mean_estimate(map(number, found)).text(digits)


def _lost(found: Sequence[Result]) -> str:
    trained = (100.0 * one.unlearned for one in found if one.unit.trained)
    return data.mean_estimate(trained).text(1)


COSTS: Mapping[str, Cell] = {
    **dict(islice(report.COSTS.items(), 4)),
    f"episodes to {LEARNED:.0%}": until(LEARNED, "episodes"),
    f"take-overs to {LEARNED:.0%}": until(LEARNED, "takeovers"),
    "human s in all": _estimate(lambda one: one.costs.human_s),
    "failed episodes": _estimate(lambda one: one.costs.failures),
}


def outcomes(results: Results) -> Mapping[str, Cell]:
    """The columns of what came of a training."""
    return {
        **{f"{name}, %": _success(name) for name in CONDITIONS},
        "lost at the end, points": _lost,
        "return over the expert's": _over(results, Line(plan.EXPERT, plan.GOOD), data.REWARD),
    }


def draw(results: Results) -> Figure:
    """Success in validation by the human's seconds so far, a panel a task, with the good human."""
    figure = Figure(figsize=(4.6 * len(TASKS), 4.4), layout="constrained")
    for panel, task in zip(figure.subplots(1, len(TASKS), sharey=True), TASKS, strict=True):
        panel.set_title(data.words(task), fontsize=10)
        for place, row in enumerate(plan.ROWS):
            line = Line(row, plan.GOOD)
            found = [result for result in results.of(task, line) if result.unit.trained]
            if not found:
                continue
            given = np.mean([result.given() for result in found], axis=0)
            success = np.mean([r.curve(data.ALONE, data.SUCCESS) for r in found], axis=0)
            look = {"color": colour(line, place), "zorder": 3 + (row == PHIL)}
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
