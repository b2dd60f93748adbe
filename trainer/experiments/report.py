"""Pages of the studies: tables in Python, prose in templates.

``NAME.md.jinja`` is the page of a study, and ``PAGES`` names the functions that it calls. A cell of
a table is made of the numbers of a line's units in one task, one row a unit.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from bridge.report import ProgressBar, markdown_table
from bridge.statistics import Estimate, mean_estimate
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.environments import CONDITIONS
from trainer.experiments import figures, plan
from trainer.experiments import records as data
from trainer.experiments.figures import PAPER_SCENES, SCENES, label
from trainer.experiments.plan import EXPERIMENTS, GOOD, HELPED, HUMANS, SCENARIOS, TASKS, Line
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
    templates.filters["listed"] = lambda values: ", ".join(f"`{k}={v}`" for k, v in values.items())
    templates.filters |= {"words": plan.words, "percent": "{:.0%}".format, "number": "{:,}".format}
    claims = store.results / CLAIMS_FILE  # Of the kept records alone
    text = templates.get_template(f"{name}.md.jinja").render(
        {function.__name__: function for function in PAGES[name]},
        algorithms=ALGORITHMS,
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


def markdown(head: Iterable[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(markdown_table([*head], rows)).rstrip("\n")


def table(records: Records, places: Iterable[tuple[str, Line]], columns: Mapping[str, Cell]) -> str:
    """Return a row for each task and line of which there is something."""
    found = ((task, line, records.of(task, line)) for task, line in places)
    rows = [(line.name, plan.words(task), *(cell(its) for cell in columns.values()))
            for task, line, its in found if len(its)]  # fmt: skip
    return markdown(("", "scenario", *columns), rows)


def shown(cell: Cell, rows: pd.DataFrame) -> str:
    """Return a cell; a dash where there is no unit."""
    return cell(rows) if len(rows) else "–"


def spread(numbers: pd.Series) -> str:
    """Return median (of an even number the upper middle), least and most, as in "12 [8, ∞]".

    Of five, 15 of 16 times the true median lies between the least and the most.
    """
    ordered = numbers.sort_values()
    ends = (f"{ordered.iloc[place]:,.0f}" for place in (len(ordered) // 2, 0, -1))
    middle, least, most = ("0" if end == "-0" else end.replace("inf", "∞") for end in ends)
    return f"{middle} [{least}, {most}]"


def until(level: float, what: str) -> Cell:
    """Show a cost until the policy alone reached a level, and how many seeds do if not all.

    A seed that never does costs more than any other.
    """

    def cell(rows: pd.DataFrame) -> str:
        costs = rows[f"{what}_to_{level:.0%}"]
        there = np.isfinite(costs).sum()
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


def computed_in(records: Records, algorithms: Iterable[str], settings: Iterable[str]) -> str:
    """Return how many of the trainings multiplied in what, and where."""
    units = records.numbers
    units = units[units.algorithm.isin([*algorithms]) & units.setting.isin([*settings])]
    kinds = units.bfloat16.map(lambda fast: "bfloat16" if fast else "float32")
    kinds += units.gpu.map(lambda gpu: "" if pd.isna(gpu) else " on a GPU")
    return ", ".join(f"{count} {kind}" for kind, count in kinds.value_counts().items())


# The paper's experiments


def presets() -> str:
    """Return the table of the settings that are not the paper's."""
    ours, printed = (asdict(PRESETS[name]) for name in ("ours", "printed"))
    for values in (ours, printed):
        values |= values.pop("learner")
    rows = [(f"`{name}`", ours[name], value) for name, value in printed.items()]
    return markdown(("setting", "ours", "printed"), [row for row in rows if row[1] != row[2]])


def anchor(name: str) -> str:
    """Return the link to the part of an experiment, as GitHub makes it."""
    return f"{name} {EXPERIMENTS[name].title}".lower().replace(",", "").replace(" ", "-")


def summary(claims: pd.DataFrame) -> str:
    """Return the table of how many claims hold, by experiment."""
    answers = {"yes": "holds", "no": "does not", "undecided": "undecided"}

    def row(title: str, about: str, of: pd.DataFrame) -> list[Any]:
        found, alone = (column.value_counts().reindex(list(answers), fill_value=0)
                        for column in (of.holds, of.holds_alone))  # fmt: skip
        return [title, about, *found, *(alone if alone.any() else [""] * len(alone))]

    parts = {name: claims[claims.experiment == name] for name in EXPERIMENTS}
    rows = [row("all", "the paper's claims", claims[claims.by == "paper"])]
    rows += [row(f"[{name}](#{anchor(name)})", EXPERIMENTS[name].title, of)
             for name, of in parts.items() if len(of)]  # fmt: skip
    alone = [f"policy alone: {answer}" for answer in answers.values()]
    return markdown(("", "about", *answers.values(), *alone), rows)


def verdicts(claims: pd.DataFrame, name: str) -> str:
    """Return the table of an experiment's claims; nothing where it has none."""
    of, paper = claims[claims.experiment == name], "wanted" if name == "goals" else "the paper"
    head = {"claim": "claim", "said": paper, "weakest": "weakest comparison", "holds": "holds"}
    if of.holds_alone.any():
        head |= {"weakest_alone": "weakest, policy alone", "holds_alone": "holds"}
    return markdown(head.values(), of[[*head]].to_numpy()) if len(of) else ""


def tests(records: Records) -> str:
    """Return the table of every policy's success in every scene, and on the paper's seeds."""

    def cell(condition: str) -> Cell:
        paper = mean(f"paper_success {condition}", 0, 100.0)
        return lambda rows: f"{share(condition)(rows)} ({paper(rows)})"

    rows = [
        (line.name, *(shown(cell(condition), records.of(scenario, line))
                      for scenario, condition in SCENES))
        for row in records.study.rows for line in row.lines
    ]  # fmt: skip
    return markdown(("", *map(label, SCENES)), [row for row in rows if {*row[1:]} != {"–"}])


def distances(records: Records, name: str, paper: Mapping[str, Sequence[str]]) -> str:
    """Return a table of the paper: our distances, of all drives on its seeds, beside its own."""
    scenes = [scene for scene in PAPER_SCENES if scene[0] in EXPERIMENTS[name].scenarios]

    def pooled(condition: str) -> Cell:
        def cell(rows: pd.DataFrame) -> str:
            each, sd = (rows[f"paper_distance_{m} {condition}"] for m in ("m", "sd_m"))
            return f"{each.mean():.2f}±{np.sqrt((sd**2).mean() + each.var(ddof=0)):.2f}"

        return cell

    rows = [
        (Line(algorithm).name,
         *(f"{shown(pooled(condition), records.of(scenario, Line(algorithm)))} ({number})"
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
    trained = [row for row in records.study.rows if row.seeds]
    lines = product((line for row in trained for line in row.lines), SCENARIOS)
    return table(records, ((task, line) for line, task in lines), COST)


# The fair table of human guidance


def short(records: Records) -> str:
    """Return the table of seconds, success and pairs, one row an algorithm."""
    seconds, success = until(LEARNED, "human_s"), mean("success nominal", 0, 100.0)
    columns = [*product((("s", seconds), ("%", success)), TASKS)]
    rows = [
        (Line(row).name,
         *(shown(cell, records.of(task, Line(row, GOOD))) for (_, cell), task in columns),
         less_in(pairs(records, row)) if row in plan.RIVALS else "–")
        for row in plan.ROWS
    ]  # fmt: skip
    titles = (f"{unit}, {plan.words(task)}" for (unit, _), task in columns)
    return markdown(("", *titles, "pairs with less than PHIL-TD3"), rows)


def pairs(records: Records, row: str, tasks: Iterable[str] = SCENARIOS) -> pd.DataFrame:
    """Return the human's seconds until a row and PHIL-TD3 had learned, pair by pair of seeds."""
    found = records.numbers
    found = found[found.scenario.isin([*tasks]) & (found.setting == GOOD)]
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


def default(records: Records) -> str | int:
    """Return which row is to be the default by the rule on the page.

    Where pairs are missing, instead how many there are of one row.
    """
    first = records.only(plan.DEFAULT_SEEDS)
    found = {row: pairs(first, row) for row in plan.RIVALS}
    if (fewest := min(map(len, found.values()))) < plan.PAIRS:
        return fewest

    def takes_its_place(row: str) -> bool:
        behind = (over(first, first.of(scenario, Line(row, GOOD)), Line(PHIL, GOOD),
                       f"success {condition}").high < 0.0
                  for scenario, condition in PAPER_SCENES)  # fmt: skip
        return (found[row].own < found[row].phil).sum() >= plan.ENOUGH and not any(behind)

    better = {row: found[row].own.quantile(interpolation="higher")
              for row in filter(takes_its_place, plan.RIVALS)}  # fmt: skip
    return Line(min(better, key=better.__getitem__, default=PHIL)).name


def late(records: Records) -> list[str]:
    """Return which rows get there in good time in every seed of none of our scenes."""
    found = records.numbers[records.numbers.scenario.isin(SCENARIOS)]
    found = found[(found.setting == GOOD) & found.algorithm.isin(plan.ROWS)]
    most = found.groupby(["algorithm", "scenario"])[f"episodes_to_{LEARNED:.0%}"].max()
    soon = most.groupby("algorithm").min() <= plan.MOST_EPISODES
    return [Line(row).name for row in plan.ROWS if not soon.get(row, False)]


def beside(records: Records) -> pd.DataFrame:
    """Return the numbers of the units that a human helps in the left turn."""
    found = records.numbers
    return found[(found.scenario == "left_turn") & found.algorithm.isin(HELPED)
                 & found.setting.isin([*HUMANS])]  # fmt: skip


def forgives(records: Records) -> tuple[list[str], list[str]]:
    """Return which rows succeed beside each human in the left turn, and which beside some not."""
    good, less = list[str](), list[str]()
    success = beside(records).groupby(["algorithm", "setting"])["success nominal"].mean().unstack()
    for row in (row for row in HELPED if row in success.index):
        shares = 100.0 * success.loc[row].reindex(list(HUMANS))
        low = [f"{plan.words(human)} {share:.1f}" for human, share in shares.items()
               if share < 100.0 * LEARNED]  # fmt: skip
        name = Line(row).name
        (less if low else good).append(f"{name} ({', '.join(low)})" if low else name)
    return good, less


def seeds_beside(records: Records, human: str) -> str:
    """Return how many seeds the rows have beside a human."""
    found = beside(records)
    counts = found[found.setting == human].algorithm.value_counts().reindex(HELPED, fill_value=0)
    return " to ".join(map(str, sorted({counts.min(), counts.max()})))


def beside_each(records: Records, title: str) -> str:
    """Return the table with a row for each algorithm, a column for each human in the left turn."""
    cell = {**COSTS, **outcomes(records), "success, nominal, %": share("nominal")}[title]
    lines = {key: cell(rows) for key, rows in beside(records).groupby(["algorithm", "setting"])}
    humans = [human for human in HUMANS if any(human == setting for _, setting in lines)]
    rows = [(Line(row).name, *(lines.get((row, human), "–") for human in humans)) for row in HELPED]
    return markdown((title, *map(plan.words, humans)), rows)


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
    return table(records, product(TASKS, lines), outcomes(records))


PAGES: Mapping[str, Sequence[Callable[..., Any]]] = {
    "paper": (presets, computed_in, anchor, summary, verdicts, tests, distances, times, cost),
    "guidance": (
        short, place, default, late, forgives, seeds_beside, beside_each, costs, came_of_it,
        computed_in,
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
        human = GOOD if records.study is plan.GUIDANCE else plan.NORMAL
        units = records.numbers[records.numbers.setting == human]
        for (task, row), its in units.groupby(["scenario", "algorithm"]):
            if row in ALGORITHMS and ALGORITHMS[row].guided:
                given, alone = (
                    np.median(records.curves(task, Line(row, human), name), axis=0)
                    for name in ("human_s", f"{data.SUCCESS} {data.ALONE}")
                )
                points = np.stack([given.round(1), alone.round(3)], axis=1).tolist()
                curve = {"human": human, "seeds": len(its), "points": points}
                curves.setdefault(TASKS[task][0], {})[row] = curve
    if not curves:
        raise UserError("there are no records of a guided training")
    write_atomic(path, (json.dumps(curves) + "\n").encode())
