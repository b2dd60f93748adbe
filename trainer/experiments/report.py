"""Pages of the studies: tables in Python, prose in templates.

``NAME.md.jinja`` is the page of a study, and ``PAGES`` names the functions that it calls. A cell of
a table is made of the numbers of a line's units in one task, one row a unit.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from statistics import median_high
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from bridge.progress import ProgressBar
from bridge.report import markdown_table
from bridge.statistics import Estimate, mean_estimate
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import figures, plan
from trainer.experiments import records as data
from trainer.experiments.figures import PAPER_SCENES, SCENES, label
from trainer.experiments.plan import (
    EXPERIMENTS,
    GOOD,
    HELPED,
    HUMANS,
    SCENARIOS,
    TASKS,
    Line,
    words,
)
from trainer.experiments.records import LEARNED, WELL, Records, Store
from trainer.learner.config import ALGORITHMS
from trainer.training.config import PRESETS

CLAIMS_FILE = "claims.csv"
"""Claims of the paper and of this project, each with the verdict of the kept records."""
Cell = Callable[[pd.DataFrame], str]
PHIL = "phil_td3"
OWN = {
    plan.MODEL: Line(plan.HUMAN_MODEL, plan.MODEL),
    plan.SLOWER: Line(plan.EXPERT, plan.SLOWER),
}
"""Humans who drive by themselves; the others are the expert, with a fault or without."""


def write_page(store: Store, records: Records) -> Path:
    """Draw all figures of a study and write its page beside the tables; return the page's path.

    Raises UserError: there are no records at all.
    """
    if not records.found:
        raise UserError(f"there are no results to report in {store.results}")
    name = store.study.name
    drawn = figures.FIGURES[name]
    with ProgressBar("report", len(drawn)) as bar:
        for title, draw in drawn.items():
            figures.write(draw(records), store.results / f"{title}.png")
            bar.advance({"drawn": title})
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    templates.filters |= {"words": words, "percent": "{:.0%}".format, "number": "{:,}".format}
    claims = store.results / CLAIMS_FILE  # Of the kept records alone
    text = templates.get_template(f"{name}.md.jinja").render(
        {function.__name__: function for function in (markdown, *PAGES[name])},
        claims=pd.read_csv(claims, keep_default_na=False) if claims.is_file() else None,
        command="python -m trainer experiment",
        data=data,
        figures=drawn,
        plan=plan,
        records=records,
        study=store.study,
        wanted=len(store.study.units(records.seeds)),
    )
    path = store.results / "README.md"
    write_atomic(path, text.encode())
    return path


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(markdown_table(head, rows)).rstrip("\n")


def table(
    records: Records,
    places: Iterable[tuple[str, Line]],
    columns: Mapping[str, Cell],
    with_tested_only: bool = False,
) -> str:
    """Return a row for each task and line of which there is something."""
    found = ((*place, records.of(*place)) for place in places)
    rows = [
        (line.name, words(task), *(cell(its) for cell in columns.values()))
        for task, line, its in found
        if len(its) and (with_tested_only or line.algorithm in ALGORITHMS)
    ]
    return markdown(("", "scenario", *columns), rows)


def shown(cell: Cell, rows: pd.DataFrame) -> str:
    """Return a cell; a dash where there is no unit."""
    return cell(rows) if len(rows) else "–"


def spread(numbers: Iterable[float]) -> str:
    """Return median (of an even number the upper middle), least and most, as in "12 [8, ∞]".

    Of five, 15 of 16 times the true median lies between the least and the most.
    """
    numbers = list(numbers)
    ends = (f"{number:,.0f}" for number in (median_high(numbers), min(numbers), max(numbers)))
    middle, least, most = ("0" if end == "-0" else end.replace("inf", "∞") for end in ends)
    return f"{middle} [{least}, {most}]"


def until(level: float, what: str) -> Cell:
    """Show a cost until the policy alone reached a level, and how many seeds do if not all.

    A seed that never does costs more than any other.
    """

    def cell(rows: pd.DataFrame) -> str:
        costs = rows[f"{what}_to_{level:.0%}"]
        there = int(np.isfinite(costs).sum())
        if what in ("human_s", "takeovers") and not ALGORITHMS[rows.algorithm.iloc[0]].guided:
            return "–"
        if not there:
            return "never"
        return spread(costs) + (f" ({there} of {len(costs)})" if there < len(costs) else "")

    return cell


def mean(column: str, digits: int = 0, factor: float = 1.0) -> Cell:
    """Show the mean of the seeds."""
    return lambda rows: f"{(factor * rows[column]).mean():,.{digits}f}"


def share(condition: str) -> Cell:
    """Show the success in the tests under a condition, with its interval."""
    return lambda rows: mean_estimate(rows[f"success {condition}"]).as_share()


def estimate(column: str, digits: int = 0, factor: float = 1.0) -> Cell:
    """Show the mean of what is never below 0, with its interval."""

    def cell(rows: pd.DataFrame) -> str:
        found = mean_estimate(factor * rows[column])
        return found._replace(low=max(found.low, 0.0) if found.size > 1 else found.low).text(digits)

    return cell


S_TO_LEARNED = f"human s to {LEARNED:.0%}"
SPENT: Mapping[str, Cell] = {
    "seeds": lambda rows: f"{len(rows)}",
    f"steps to {LEARNED:.0%}": until(LEARNED, "steps"),
    S_TO_LEARNED: until(LEARNED, "human_s"),
    f"human s to {WELL:.0%}": until(WELL, "human_s"),
}
COST: Mapping[str, Cell] = {
    **SPENT,
    "validation lost at the end, points": mean("unlearned", 1, 100.0),
    "by the worst seed": lambda rows: f"{100 * rows.unlearned.max():.1f}",
    "human steps": mean("human_steps"),
    "take-overs": mean("takeovers"),
    "failures": mean("failures"),
    "updates": mean("updates"),
}
"""Columns of the paper's experiments."""
COSTS: Mapping[str, Cell] = {
    **SPENT,
    f"episodes to {LEARNED:.0%}": until(LEARNED, "episodes"),
    **{f"take-overs to {level:.0%}": until(level, "takeovers") for level in (LEARNED, WELL)},
    f"failed episodes to {LEARNED:.0%}": until(LEARNED, "failures"),
    "human s in all": estimate("human_s"),
    "failed episodes": estimate("failures"),
}
"""Columns of the table of human guidance."""


def computed_in(records: Records, lines: Iterable[Line]) -> str:
    """Return how many of the trainings multiplied in what, and where."""
    units = pd.concat([records.of(task, line) for task, line in product(TASKS, lines)])
    counts = Counter(
        ("bfloat16" if fast else "float32") + ("" if pd.isna(gpu) else " on a GPU")
        for fast, gpu in zip(units.bfloat16, units.gpu, strict=True)
    )
    return ", ".join(f"{count} {what}" for what, count in counts.most_common())


# The paper's experiments


def presets() -> str:
    """Return the table of the settings that are not the paper's."""
    ours, printed = (asdict(PRESETS[name]) for name in ("ours", "printed"))
    for values in (ours, printed):
        values |= values.pop("learner")
    rows = [(f"`{name}`", ours[name], value) for name, value in printed.items()]
    return markdown(("setting", "ours", "printed"), [row for row in rows if row[1] != row[2]])


def settings(records: Records) -> str:
    """Return the table of what is trained, and in what it was computed."""
    rows = []
    for row in (row for row in records.study.rows if row.seeds):
        lines = [Line(name, row.setting) for name in row.algorithms]
        names = ", ".join(Line(name).name for name in row.algorithms)
        meaning = plan.SETTINGS[row.setting].meaning
        rows.append((words(row.setting), meaning, names, computed_in(records, lines)))
    return markdown(("setting", "meaning", "algorithms", "computed in"), rows)


def anchor(name: str) -> str:
    """Return the link to the part of an experiment, as GitHub makes it."""
    return f"{name} {EXPERIMENTS[name].title}".lower().replace(",", "").replace(" ", "-")


def summary(claims: pd.DataFrame) -> str:
    """Return the table of how many claims hold, by experiment."""
    answers = {"yes": "holds", "no": "does not", "undecided": "undecided"}

    def row(title: str, about: str, of: pd.DataFrame) -> tuple[Any, ...]:
        found, alone = ([(column == answer).sum() for answer in answers]
                        for column in (of.holds, of.holds_alone))  # fmt: skip
        return (title, about, *found, *(alone if any(alone) else [""] * len(alone)))

    rows = [row("all", "the paper's claims", claims[claims.by == "paper"])]
    for name, one in EXPERIMENTS.items():
        if len(of := claims[claims.experiment == name]):
            rows.append(row(f"[{name}](#{anchor(name)})", one.title, of))
    alone = [f"policy alone: {answer}" for answer in answers.values()]
    return markdown(("", "about", *answers.values(), *alone), rows)


def verdicts(claims: pd.DataFrame, name: str) -> str:
    """Return the table of an experiment's claims; nothing where it has none."""
    of, paper = claims[claims.experiment == name], "wanted" if name == "goals" else "the paper"
    columns = ["claim", "said", "weakest", "holds", "weakest_alone", "holds_alone"]
    head = ("claim", paper, "weakest comparison", "holds", "weakest, policy alone", "holds")
    count = 6 if of.holds_alone.any() else 4
    return markdown(head[:count], of[columns[:count]].to_numpy()) if len(of) else ""


def tests(records: Records) -> str:
    """Return the table of every policy's success in every scene, and on the paper's seeds."""

    def cell(condition: str) -> Cell:
        paper = mean(f"paper_success {condition}", 0, 100.0)
        return lambda rows: f"{share(condition)(rows)} ({paper(rows)})"

    rows = [
        (line.name, *(shown(cell(condition), records.of(scenario, line))
                      for scenario, condition in SCENES))
        for line in plan.lines_of(records.study)
    ]  # fmt: skip
    return markdown(("", *map(label, SCENES)), [row for row in rows if {*row[1:]} != {"–"}])


def distances(records: Records, name: str, paper: Mapping[str, Sequence[str]]) -> str:
    """Return a table of the paper: our distances, of all drives on its seeds, beside its own."""
    scenes = [scene for scene in PAPER_SCENES if scene[0] in EXPERIMENTS[name].scenarios]

    def cell(condition: str) -> Cell:
        def pooled(rows: pd.DataFrame) -> str:
            each, sd = (rows[f"paper_distance_{m} {condition}"] for m in ("m", "sd_m"))
            return f"{each.mean():.2f}±{np.sqrt((sd**2).mean() + each.var(ddof=0)):.2f}"

        return pooled

    rows = [
        (Line(algorithm).name,
         *(f"{shown(cell(condition), records.of(scenario, Line(algorithm)))} ({number})"
           for (scenario, condition), number in zip(scenes, numbers, strict=True)))
        for algorithm, numbers in paper.items()
    ]  # fmt: skip
    return markdown(("", *map(label, scenes)), rows)


def times(records: Records, paper: Mapping[str, float]) -> str:
    """Return the paper's table of time efficiency, seconds for 10,000 steps, beside ours."""
    units = [records.of(SCENARIOS[0], Line(name)) for name in paper]
    ours = [mean_estimate(1e4 * its.training_s / its.steps).text(0) for its in units]
    head = ("", *(Line(name).name for name in paper))
    return markdown(head, [("the paper", *paper.values()), ("ours", *ours)])


def cost(records: Records) -> str:
    """Return the table of what each line's trainings cost."""
    lines = product(plan.lines_of(records.study), SCENARIOS)
    return table(records, ((task, line) for line, task in lines), COST)


# The fair table of human guidance


def short(records: Records) -> str:
    """Return the table of seconds, success and pairs, one row an algorithm."""
    columns = {
        **{f"s, {words(task)}": (task, until(LEARNED, "human_s")) for task in TASKS},
        **{f"%, {words(task)}": (task, mean("success nominal", 0, 100.0)) for task in TASKS},
    }
    rows = [
        (Line(row).name,
         *(shown(cell, records.of(task, Line(row, GOOD))) for task, cell in columns.values()),
         less_in(pairs(records, row)) if row in HELPED and row != PHIL else "–")
        for row in plan.ROWS
    ]  # fmt: skip
    return markdown(("", *columns, "pairs with less than PHIL-TD3"), rows)


def pairs(records: Records, row: str, tasks: Iterable[str] = SCENARIOS) -> pd.DataFrame:
    """Return the human's seconds until a row and PHIL-TD3 had learned, pair by pair of seeds."""
    lines = product(tasks, [Line(row, GOOD), Line(PHIL, GOOD)])
    found = pd.concat([records.of(*each) for each in lines])
    learned = f"human_s_to_{LEARNED:.0%}"
    found = found.pivot(index=["scenario", "seed"], columns="algorithm", values=learned)
    return found.reindex(columns=[row, PHIL]).dropna().set_axis(["own", "phil"], axis=1)


def less_in(found: pd.DataFrame) -> str:
    """Return in how many pairs a row needs less of the human than PHIL-TD3."""
    return f"{(found.own < found.phil).sum()} of {len(found)}"


def over(records: Records, rows: pd.DataFrame, other: Line, column: str) -> Estimate:
    """Return a number less another line's, paired by seed; an untrained line pairs with each."""
    theirs = records.of(rows.scenario.iloc[0], other).set_index("seed")[column]
    return mean_estimate(rows.set_index("seed")[column] - theirs.get(0, theirs))


def place(records: Records) -> str:
    """Return the table of each row less PHIL-TD3."""

    def points(rows: pd.DataFrame) -> str:
        return over(records, rows, Line(PHIL, GOOD), "success nominal").times(100.0).text(1)

    def of(rows: pd.DataFrame) -> pd.DataFrame:
        return pairs(records, rows.algorithm.iloc[0], [rows.scenario.iloc[0]])

    def sooner(rows: pd.DataFrame) -> str:
        found = of(rows)
        less = (found.own - found.phil).where(found.own != found.phil, 0.0)
        return spread(less) if np.isfinite(found).any(axis=None) else "–"

    columns = {"success, nominal, points": points, S_TO_LEARNED: sooner,
               "less in": lambda rows: less_in(of(rows))}  # fmt: skip
    return table(records, product(TASKS, [Line(row, GOOD) for row in plan.RIVALS]), columns)


def verdict(records: Records) -> str:
    """Return which row is to be the default by the rule on the page, in a sentence."""
    first = records.only(plan.DEFAULT_SEEDS)
    found = {row: pairs(first, row) for row in plan.RIVALS}
    fewest = min(map(len, found.values()))
    if fewest < plan.PAIRS:
        there = f"{fewest} of {plan.PAIRS} pairs are there"
        return f"The default cannot be judged yet: of one row {there}."

    def takes_its_place(row: str) -> bool:
        behind = (over(first, first.of(scenario, Line(row, GOOD)), Line(PHIL, GOOD),
                       f"success {condition}").high < 0.0
                  for scenario, condition in PAPER_SCENES)  # fmt: skip
        return (found[row].own < found[row].phil).sum() >= plan.ENOUGH and not any(behind)

    better = filter(takes_its_place, plan.RIVALS)
    best = min(better, key=lambda row: median_high(found[row].own), default=PHIL)
    return f"By the rule the default is {Line(best).name}."


def learns(records: Records) -> str:
    """Return which rows get there in good time in every seed of one of our scenes."""

    def is_soon(rows: pd.DataFrame) -> bool:
        return len(rows) > 0 and (rows[f"episodes_to_{LEARNED:.0%}"] <= plan.MOST_EPISODES).all()

    late = [
        Line(row).name
        for row in plan.ROWS
        if not any(is_soon(records.of(task, Line(row, GOOD))) for task in SCENARIOS)
    ]
    return (
        f"all rows but {', '.join(late)} ([why](../README.md#the-fair-table))"
        if late
        else "all rows"
    )


def forgives(records: Records) -> str:
    """Return which rows succeed beside each human in the left turn, and which beside some not."""
    good, less = [], []
    for row in HELPED:
        units = {human: records.of("left_turn", Line(row, human)) for human in HUMANS}
        shares = {human: 100.0 * its["success nominal"].mean() for human, its in units.items()}
        low = [f"{words(human)} {success:.1f}" for human, success in shares.items()
               if success < 100.0 * LEARNED]  # fmt: skip
        if low:
            less.append(f"{Line(row).name} ({', '.join(low)})")
        elif any(map(len, units.values())):
            good.append(Line(row).name)
    beside_some = f" Less beside some: {'; '.join(less)}." if less else ""
    return f"{', '.join(good) or 'no row'}.{beside_some}"


def seeds_beside(records: Records, human: str) -> str:
    """Return how many seeds the rows have beside a human."""
    counts = [len(records.of("left_turn", Line(row, human))) for row in HELPED]
    return " to ".join(map(str, sorted({min(counts), max(counts)})))


def beside_each(records: Records, title: str) -> str:
    """Return the table with a row for each algorithm, a column for each human in the left turn."""
    cell = {**COSTS, **outcomes(records), "success, nominal, %": share("nominal")}[title]
    found = {human: [records.of("left_turn", Line(row, human)) for row in HELPED]
             for human in HUMANS}  # fmt: skip
    found = {human: each for human, each in found.items() if any(map(len, each))}
    cells = [[shown(cell, rows) for rows in each] for each in found.values()]
    names = (Line(row).name for row in HELPED)
    return markdown((title, *map(words, found)), list(zip(names, *cells, strict=True)))


def outcomes(records: Records) -> Mapping[str, Cell]:
    """Return the columns of what came of a training."""

    def less_the_humans(rows: pd.DataFrame) -> str:
        expert, setting = Line(plan.EXPERT, GOOD), rows.setting.iloc[0]
        trained = rows.algorithm.iloc[0] in ALGORITHMS
        human = OWN.get(setting, expert) if trained else expert
        return over(records, rows, human, "reward nominal").text(2)

    return {
        **{f"{condition}, %": share(condition) for condition in CONDITIONS},
        "lost at the end, points": estimate("unlearned", 1, 100.0),
        "return over the human's, nominal": less_the_humans,
    }


def costs(records: Records) -> str:
    """Return the table of what a training cost with the scripted expert."""
    return table(records, product(TASKS, [Line(row, GOOD) for row in plan.ROWS]), COSTS)


def came_of_it(records: Records) -> str:
    """Return the table of how the policies drive alone, and the humans."""
    lines = [*(Line(row, GOOD) for row in (*plan.ROWS, plan.EXPERT)), *OWN.values()]
    return table(records, product(TASKS, lines), outcomes(records), with_tested_only=True)


def own_settings() -> str:
    """Return the table of the hyper-parameters that each row has of its own."""
    rows = [
        (Line(row).name, f"`{row}`", *(
            ", ".join(f"`{name}={value}`" for name, value in values.items())
            for values in (ALGORITHMS[row].settings, plan.TUNED.get(row, {}))
        ))
        for row in plan.ROWS
    ]  # fmt: skip
    return markdown(("", "`NAME`", "settings of its own", "in this table alone"), rows)


def guided_in(records: Records) -> str:
    """Return how many of the table's trainings multiplied in what."""
    return computed_in(records, [Line(*each) for each in product(plan.ROWS, HUMANS)])


PAGES: Mapping[str, Sequence[Callable[..., Any]]] = {
    "paper": (presets, settings, anchor, summary, verdicts, tests, distances, times, cost),
    "guidance": (
        short, place, verdict, learns, forgives, seeds_beside, beside_each, costs, came_of_it,
        own_settings, guided_in,
    ),
}  # fmt: skip
"""Study -> what its template calls."""


def write_typical(found: Iterable[Records], path: Path) -> None:
    """Write the curves that a person's coach shows.

    Environment -> algorithm -> the medians of the seeds with an ordinary human, at the grid's
    steps: pairs of the seconds that the human had driven and the policy's success alone.

    Raises UserError: there is no record to make a curve of.
    """
    curves: dict[str, dict[str, Any]] = {}
    for records in found:
        human = GOOD if records.study.name == plan.GUIDANCE.name else plan.NORMAL
        for scenario, row in sorted({(unit.scenario, unit.algorithm) for unit in records.found}):
            units = records.units_of(scenario, Line(row, human))
            if row in ALGORITHMS and ALGORITHMS[row].guided and units:
                grid = records.grid(scenario)
                given = np.median([records.human_s(unit, grid) for unit in units], axis=0)
                alone = np.median(
                    [records.curve(unit, data.ALONE, data.SUCCESS, grid) for unit in units], axis=0
                )
                points = np.stack([given.round(1), alone.round(3)], axis=1).tolist()
                curves.setdefault(units[0].environment, {})[row] = {
                    "human": human, "seeds": len(units), "points": points
                }  # fmt: skip
    if not curves:
        raise UserError("there are no records of a guided training")
    write_atomic(path, (json.dumps(curves) + "\n").encode())
