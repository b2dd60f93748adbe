"""The fair table of human guidance: what each row costs the human, and what comes of it.

One page and one figure beside the records, made of what is there.
"""

import json
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bridge.report import markdown_table
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import data, plan
from trainer.experiments.data import Line, Result, Results
from trainer.experiments.report import COMMAND, LEARNED, WELL, colour, spread, until
from trainer.experiments.run import Store
from trainer.pictures import write_figure

TASKS = (*plan.SCENARIOS, *plan.FOREIGN)
PHIL = "phil_td3"
OTHER_HUMANS = (Line(plan.HUMAN_MODEL, plan.MODEL), Line(plan.EXPERT, "slower"))
"""Other humans who drive by themselves."""


def write_guidance(store: Store, seeds: int) -> Path:
    """Write the page and its figure; the page's path.

    Raises UserError: there are no records at all.
    """
    results = data.load(store, seeds, plan.GUIDANCE)
    if not results.found:
        raise UserError(f"there are no results to report in {store.results}")
    write_figure(draw(results), store.results / f"{plan.GUIDANCE}.png")
    path = store.results / "README.md"
    write_atomic(path, ("\n".join(_page(results, store)) + "\n").encode())
    return path


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
    yield from (
        "# The fair table of human guidance",
        "",
        f"`{COMMAND} {plan.GUIDANCE}` computes what is missing and writes this page. "
        f"{len(results.found)} of {wanted} trainings and tests are there.",
        "",
        "Every row has the same scenes, human, replay buffer and budget of environment steps "
        f"({budgets}). **Every human here is a script or a model of one: no person's cost is "
        "claimed.** Seconds are simulated ones in which the human drove. Numbers are means of the "
        "seeds with their 95 % interval; what it took to a level is the median of the seeds, the "
        "least and the most of them (∞: never), and how many get there. Validations are "
        f"{store.plan.evaluate_every_steps} steps apart (racetrack: {slow.evaluate_every_steps}, "
        f"of {slow.evaluation_runs} drives), so no finer difference counts. The actor that is "
        "tested is the best in them by success, then by the scene's return, for every row.",
        "",
        f"![Success of the policy alone by what the human has given]({plan.GUIDANCE}.png)",
        "",
        f"## With {plan.HUMANS[plan.GOOD].meaning}",
        "",
    )
    head = (
        "", "task", "seeds", *(f"human s to {level:.0%}" for level in (LEARNED, WELL)),
        f"take-overs to {LEARNED:.0%}", "human s in all", "failures",
        *(f"{name}, %" for name in CONDITIONS), "return over the human's",
    )  # fmt: skip
    lines = [*(Line(row, plan.GOOD) for row in (*plan.ROWS, plan.EXPERT)), *OTHER_HUMANS]
    rows = [
        _row(results, task, line, found)
        for task in TASKS
        for line in lines
        if (found := results.of(task, line))
    ]
    yield from markdown_table(head, rows)
    yield from (
        "## PHIL-TD3's place",
        "",
        "With the same human: each row less PHIL-TD3, pair by pair of seeds; of the human's "
        "seconds the median, the least and the most. ∞: the row never gets there; -∞: PHIL-TD3 "
        "never does; 0: neither.",
        "",
    )
    places = [
        (Line(row).name, data.words(task), *_place(results, task, row))
        for task in TASKS
        for row in plan.HELPED
        if row != PHIL and results.of(task, Line(row, plan.GOOD))
    ]
    yield from markdown_table(
        ("", "task", "success, nominal, points", f"human s to {LEARNED:.0%}"), places
    )
    yield from (
        "## Which row forgives which human",
        "",
        "Left turn: success of the policy alone in %, then the human's seconds until it "
        f"reached {LEARNED:.0%} in validation.",
        "",
    )
    kinds = [f"{data.words(name)}: {human.meaning}" for name, human in plan.HUMANS.items()]
    yield from markdown_table(
        ("", *kinds), [(Line(row).name, *_cells(results, row)) for row in plan.ROWS]
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."


def _row(results: Results, task: str, line: Line, found: list[Result]) -> tuple[str, ...]:
    nominal, tested = data.Scene(task, "nominal"), found[0].record["tests"]
    shares = {
        name: results.estimate(data.Scene(task, name), line, data.SUCCESS).as_share()
        for name in tested
    }
    over = results.differences(nominal, line, Line(plan.EXPERT, plan.GOOD), data.REWARD).values()
    usual = line.setting in (plan.GOOD, plan.MODEL)
    return (
        Line(line.algorithm).name if usual else line.name,
        data.words(task),
        str(len(found)),
        *(_costs(found) if found[0].unit.trained else ["–"] * 5),
        *(shares.get(name, "–") for name in CONDITIONS),
        data.mean_estimate(over).text(2),
    )


def _costs(found: list[Result]) -> Iterator[str]:
    yield from (until(found, level, "human_s") for level in (LEARNED, WELL))
    yield until(found, LEARNED, "takeovers")
    for what in ("human_s", "failures"):
        yield data.mean_estimate(getattr(one.costs, what) for one in found).text(0)


def _place(results: Results, task: str, row: str) -> Iterator[str]:
    line, phil = Line(row, plan.GOOD), Line(PHIL, plan.GOOD)
    over = results.differences(data.Scene(task, "nominal"), line, phil, data.SUCCESS).values()
    yield data.mean_estimate(over).times(100.0).text(1)
    given, its = (
        {
            one.unit.seed: cost.human_s if (cost := one.until(LEARNED)) else np.inf
            for one in results.of(task, each)
        }
        for each in (line, phil)
    )
    both = [(given[seed], its[seed]) for seed in given.keys() & its.keys()]
    yield spread([own - other if own != other else 0.0 for own, other in both]) if both else "–"


def _cells(results: Results, row: str) -> Iterator[str]:
    for human in plan.HUMANS:
        found = results.of(plan.LEFT[0], Line(row, human))
        share = results.estimate(
            data.Scene(plan.LEFT[0], "nominal"), Line(row, human), data.SUCCESS
        ).as_share()
        yield f"{share}, {until(found, LEARNED, 'human_s')}" if found else "–"


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
            panel.plot(given, success, "-o", ms=3, color=colour(line, place), label=Line(row).name)
        panel.grid(alpha=0.3)
        panel.set_xlabel("seconds that the human has driven", fontsize=9)
    shown = [zip(*panel.get_legend_handles_labels(), strict=True) for panel in figure.axes]
    rows = {label: handle for handle, label in chain(*shown)}
    if rows:
        figure.legend(rows.values(), rows.keys(), fontsize=8, ncols=5, loc="outside upper center")
    figure.supylabel("success of the policy alone, validation", fontsize=9)
    return figure
