"""Write the studies' pages: tables and figures in Python, prose in templates.

``NAME.md.jinja`` is the page of a study; it calls the functions of this module. A `Cell` turns the
numbers of a line's units in one task, one row a unit, into a table's cell.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bridge.outcomes import Estimate, mean_estimate
from bridge.report import markdown_table, write_figure
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer import experiments as plan
from trainer.environments import CONDITIONS
from trainer.experiments import Line
from trainer.experiments import records as data
from trainer.experiments.records import ALONE, DISTANCE, REWARD, SUCCESS, TRAINING, Records, Store
from trainer.learner.config import ALGORITHMS
from trainer.training.config import PRESETS, flat

Cell = Callable[[pd.DataFrame], str]
PHIL = Line("phil_td3", plan.GOOD)
PAIRS = len(plan.SCENARIOS) * plan.DEFAULT_SEEDS
ENOUGH = 9  # Pairs to win; an equally good row wins so many by chance in one of 93 cases
MOST_EPISODES = 100  # A row of the table of human guidance should learn within these
SCENES = [*product(plan.SCENARIOS, CONDITIONS)]
PAPER_SCENES = [scene for scene in SCENES if scene[1] != "dense"]
BESIDE = [Line(row, plan.GOOD) for row in plan.ROWS]
"""The rows of the table of human guidance, beside the scripted expert."""
ONE_UPDATE, *MORE_UPDATES = UPDATES_A_STEP = [
    PHIL._replace(setting=each) for each in ("one_update", "four_updates", "sixteen_updates")
]
OWN = {"model": Line("human_model", "model"), "slower": Line("expert", "slower")}
"""Humans with a policy of their own; all others are the expert, with or without a fault."""


def write_page(store: Store, records: Records) -> Path:
    """Draw all figures of a study and write its page beside the tables; return the page's path.

    Raises UserError: there are no records at all.
    """
    if not records.found:
        raise UserError(f"there are no results to report in {store.results}")
    name = store.study.name
    for title, draw in FIGURES[name].items():
        write_figure(draw(records), store.results / f"{title}.png")
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    templates.filters["listed"] = lambda values: ", ".join(f"`{k}={v}`" for k, v in values.items())
    templates.filters |= {"words": plan.words, "percent": "{:.0%}".format, "number": "{:,}".format}
    templates.filters |= {"label": label, "cell": lambda text: text.replace("|", "/")}
    claims = store.results / "claims.csv"  # The verdicts on the paper's claims
    text = templates.get_template(f"{name}.md.jinja").render(
        globals(),
        claims=pd.read_csv(claims, keep_default_na=False) if claims.is_file() else None,
        command="python -m trainer experiment",
        data=data,
        drawn=FIGURES[name],
        records=records,
        study=store.study,
        wanted=len(store.study.units(records.seeds)),
    )
    path = store.results / "README.md"
    write_atomic(path, text.encode())
    return path


def label(scene: tuple[str, str]) -> str:
    """Return scenario and condition as in the paper's figure 9: L, L-N, L-V, C, ..."""
    letter, condition = scene[0][0].upper(), scene[1]
    return letter if condition == "nominal" else f"{letter}-{condition[0].upper()}"


def table(records: Records, places: Iterable[tuple[str, Line]], columns: Mapping[str, Cell]) -> str:
    """Return a Markdown table with a row for each task and line that has units."""
    lines = ((task, line, records.of(task, line)) for task, line in places)
    rows = [(line.name, plan.words(task), *(cell(units) for cell in columns.values()))
            for task, line, units in lines if len(units)]  # fmt: skip
    return "\n".join(markdown_table(["", "scenario", *columns], rows)).rstrip("\n")


def shown(cell: Cell, records: Records, task: str, line: Line) -> str:
    """Return a line's cell, or a dash if it has no units."""
    rows = records.of(task, line)
    return cell(rows) if len(rows) else "–"


def spread(numbers: pd.Series) -> str:
    """Return median (upper one of an even count), minimum and maximum, as in "12 [8, ∞]"."""
    ordered = numbers.sort_values()
    ends = (f"{ordered.iloc[place]:,.0f}" for place in (len(ordered) // 2, 0, -1))
    middle, least, most = ("0" if end == "-0" else end.replace("inf", "∞") for end in ends)
    return f"{middle} [{least}, {most}]"


def until(level: float, what: str) -> Cell:
    """Show the cost until the policy alone reached a level, and how many seeds did if not all.

    A seed that never reached it counts as infinite cost.
    """

    def cell(rows: pd.DataFrame) -> str:
        costs = rows[f"{what}_to_{level:.0%}"]
        reached = np.isfinite(costs).sum()
        if what in ("human_s", "takeovers") and not ALGORITHMS[rows.algorithm.iloc[0]].guided:
            return "–"
        if not reached:
            return "never"
        return spread(costs) + (f" ({reached} of {len(costs)})" if reached < len(costs) else "")

    return cell


def mean(column: str, digits: int = 0, factor: float = 1.0) -> Cell:
    return lambda rows: f"{(factor * rows[column]).mean():,.{digits}f}"


def share(condition: str) -> Cell:
    """Show the success in the tests under a condition, with its interval."""
    return lambda rows: mean_estimate(rows[f"success {condition}"]).as_share()


def estimate(column: str, digits: int = 0, factor: float = 1.0) -> Cell:
    """Show the mean of a column that is never below 0, with its interval."""

    def cell(rows: pd.DataFrame) -> str:
        result = mean_estimate(factor * rows[column])
        low = max(result.low, 0.0) if result.size > 1 else result.low
        return result._replace(low=low).text(digits)

    return cell


S_TO_LEARNED, S_LEARNED = f"human s to {data.LEARNED:.0%}", f"human_s_to_{data.LEARNED:.0%}"
SPENT: Mapping[str, Cell] = {
    "seeds": lambda rows: f"{len(rows)}",
    f"steps to {data.LEARNED:.0%}": until(data.LEARNED, "steps"),
    S_TO_LEARNED: until(data.LEARNED, "human_s"),
    f"human s to {data.WELL:.0%}": until(data.WELL, "human_s"),
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
    f"episodes to {data.LEARNED:.0%}": until(data.LEARNED, "episodes"),
    **{f"take-overs to {level:.0%}": until(level, "takeovers") for level in data.LEVELS},
    f"failed episodes to {data.LEARNED:.0%}": until(data.LEARNED, "failures"),
    "human s in all": estimate("human_s"),
    "failed episodes": estimate("failures"),
}
"""Columns of the table of human guidance."""


def computed_in(records: Records, algorithms: Iterable[str], settings: Iterable[str]) -> str:
    """Return the number of trainings by precision and device, such as "3 bfloat16"."""
    units = records.numbers
    units = units[units.algorithm.isin([*algorithms]) & units.setting.isin([*settings])]
    kinds = units.bfloat16.map(lambda fast: "bfloat16" if fast else "float32")
    kinds += units.gpu.map(lambda gpu: "" if pd.isna(gpu) else " on a GPU")
    return ", ".join(f"{count} {kind}" for kind, count in kinds.value_counts().items())


# The paper's experiments


def presets() -> list[tuple[str, Any, Any]]:
    """Return the settings that differ from the paper's: name, our value, the paper's."""
    ours, printed = (flat(PRESETS[name]) for name in ("ours", "printed"))
    return [(name, ours[name], value) for name, value in printed.items() if value != ours[name]]


def tested(condition: str) -> Cell:
    """Show the success under a condition, and in brackets on the paper's seeds alone."""
    paper = mean(f"paper_success {condition}", 0, 100.0)
    return lambda rows: f"{share(condition)(rows)} ({paper(rows)})"


def pooled(condition: str) -> Cell:
    """Show the distance of all drives on the paper's seeds, mean and standard deviation."""

    def cell(rows: pd.DataFrame) -> str:
        each, sd = (rows[f"paper_distance_{m} {condition}"] for m in ("m", "sd_m"))
        return f"{each.mean():.2f}±{np.sqrt((sd**2).mean() + each.var(ddof=0)):.2f}"

    return cell


def seconds(rows: pd.DataFrame) -> str:
    """Show the seconds of 10,000 training steps."""
    return mean_estimate(1e4 * rows.training_s / rows.steps).text(0)


def cost(records: Records) -> str:
    lines = [line for row in records.study.rows if row.seeds for line in row.lines]
    return table(records, ((task, line) for line in lines for task in plan.SCENARIOS), COST)


# The fair table of human guidance


def pairs(
    records: Records, own: Line, tasks: Iterable[str] = plan.SCENARIOS, other: Line = PHIL
) -> pd.DataFrame:
    """Return the human seconds until two lines had learned, one pair a task and seed."""

    def learned(line: Line) -> pd.Series:
        units = pd.concat([records.of(task, line) for task in tasks])
        units = units[units.seed <= plan.DEFAULT_SEEDS]
        return units.set_index(["scenario", "seed"])[S_LEARNED]

    return pd.concat({"own": learned(own), "other": learned(other)}, axis=1).dropna()


def less_in(found: pd.DataFrame) -> str:
    """Return in how many pairs a line needs fewer human seconds than the other."""
    return f"{(found.own < found.other).sum()} of {len(found)}"


def over(records: Records, rows: pd.DataFrame, other: Line, column: str) -> Estimate:
    """Return a column minus another line's, paired by seed; an untrained line pairs with all."""
    theirs = records.of(rows.scenario.iloc[0], other).set_index("seed")[column]
    return mean_estimate(rows.set_index("seed")[column] - theirs.get(0, theirs))


def beside_phil(records: Records) -> Mapping[str, Cell]:
    def points(rows: pd.DataFrame) -> str:
        return over(records, rows, PHIL, "success nominal").times(100.0).text(1)

    def pairs_of(rows: pd.DataFrame) -> pd.DataFrame:
        return pairs(records, Line(rows.algorithm.iloc[0], plan.GOOD), [rows.scenario.iloc[0]])

    def sooner(rows: pd.DataFrame) -> str:
        both = pairs_of(rows)
        less = (both.own - both.other).where(both.own != both.other, 0.0)
        return spread(less) if np.isfinite(both).any(axis=None) else "–"

    return {"success, nominal, points": points, S_TO_LEARNED: sooner,
            "less in": lambda rows: less_in(pairs_of(rows))}  # fmt: skip


def default(records: Records) -> str | int:
    """Return the row that the rule on the page makes the default.

    While pairs are missing, return instead the number of pairs of the row with the fewest.
    """
    pairs_of = {line: pairs(records, line) for line in BESIDE if line.algorithm in plan.RIVALS}
    if (fewest := min(map(len, pairs_of.values()))) < PAIRS:
        return fewest

    def takes_its_place(line: Line) -> bool:
        behind = (over(records, records.of(scenario, line), PHIL, f"success {condition}").high < 0.0
                  for scenario, condition in PAPER_SCENES)  # fmt: skip
        return (pairs_of[line].own < pairs_of[line].other).sum() >= ENOUGH and not any(behind)

    better = {line: pairs_of[line].own.quantile(interpolation="higher")
              for line in filter(takes_its_place, pairs_of)}  # fmt: skip
    return min(better, key=better.__getitem__, default=PHIL).name


def late(records: Records) -> list[str]:
    """Return the rows that learn within ``MOST_EPISODES`` in all seeds in neither of our scenes."""

    def in_time(task: str, line: Line) -> bool:
        return records.of(task, line)[f"episodes_to_{data.LEARNED:.0%}"].max() <= MOST_EPISODES

    return [line.name for line in BESIDE if not any(in_time(task, line) for task in plan.SCENARIOS)]


def forgives(records: Records) -> tuple[list[str], list[str]]:
    """Return the rows that succeed with every human in the left turn, and those that do not."""
    good, less = list[str](), list[str]()
    for row in plan.HELPED:
        units = {human: records.of("left_turn", Line(row, human)) for human in plan.HUMANS}
        shares = {human: 100.0 * rows["success nominal"].mean() for human, rows in units.items()}
        low = [f"{plan.words(human)} {share:.1f}" for human, share in shares.items()
               if share < 100.0 * data.LEARNED]  # fmt: skip
        if low:
            less.append(f"{Line(row).name} ({', '.join(low)})")
        elif any(map(len, units.values())):
            good.append(Line(row).name)
    return good, less


def outcomes(records: Records) -> Mapping[str, Cell]:
    """Return the columns with the results of a training."""

    def less_the_humans(rows: pd.DataFrame) -> str:
        trained = rows.algorithm.iloc[0] in ALGORITHMS
        human = OWN.get(rows.setting.iloc[0]) if trained else None
        return over(records, rows, human or Line("expert", plan.GOOD), "reward nominal").text(2)

    return {
        **{f"{condition}, %": share(condition) for condition in CONDITIONS},
        "lost at the end, points": estimate("unlearned", 1, 100.0),
        "return over the human's, nominal": less_the_humans,
    }


# Figures

Draw = Callable[[Records], Figure]
LOOKS: Mapping[str, Any] = plan.DATA["looks"]
CURVES = ((REWARD, TRAINING), (DISTANCE, TRAINING), (SUCCESS, ALONE), (DISTANCE, ALONE))
TIME_S, LATERAL, LONGITUDINAL = data.ARRIVED_ONLY


def _look(line: Line, place: int) -> dict[str, Any]:
    others = LOOKS["other_colours"]
    colour = LOOKS["colours"].get(line.algorithm, others[place % len(others)])
    return {"color": colour, "label": line.name}


def draw_curves(name: str, records: Records) -> Figure:
    """Draw a row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row").flat
    curves_of = product(plan.SCENARIOS, CURVES)
    for panel, (scenario, (metric, kind)) in zip(panels, curves_of, strict=True):
        panel.set_title(f"{plan.words(scenario)}: {LOOKS['titles'][metric]}, {kind}", fontsize=10)
        for place, line in enumerate(plan.EXPERIMENTS[name].lines):
            curves = records.curves(scenario, line, f"{metric} {kind}")
            # The printed reward is on another scale.
            if len(curves) and (metric, line.setting) != (REWARD, "printed"):
                style = "-" if line.setting == plan.NORMAL else "--"
                x, look = records.grid(scenario), _look(line, place)
                mean, std = curves.mean(axis=0), curves.std(axis=0, ddof=min(len(curves) - 1, 1))
                panel.plot(x, mean, style, lw=1.8, **look)
                panel.fill_between(x, mean - std, mean + std, color=look["color"], alpha=0.15, lw=0)
        if metric != REWARD:
            best = 1.0 if metric == SUCCESS else plan.FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(top=1.05 * best)
        panel.grid(alpha=0.3)
    if panel.get_legend_handles_labels()[1]:
        panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_points(name: str, quantities: list[tuple[str, str]], records: Records) -> Figure:
    """Draw the lines side by side under each test condition.

    ``quantities``: for each row of panels one in the left turn, one in the congestion.
    """
    lines, names = plan.EXPERIMENTS[name].lines, list(CONDITIONS)
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * len(quantities)), layout="constrained")
    panels = figure.subplots(len(quantities), len(plan.SCENARIOS), squeeze=False).flat
    for panel, (scenario, quantity) in zip(
        panels, ((s, q) for row in quantities for s, q in zip(plan.SCENARIOS, row, strict=True)),
        strict=True,
    ):  # fmt: skip
        panel.set_title(f"{plan.words(scenario)}: {LOOKS['titles'][quantity]}", fontsize=10)
        for place, line in enumerate(lines):
            units = records.of(scenario, line)
            units = units.reindex(columns=[f"{quantity} {condition}" for condition in names])
            x = np.arange(len(names)) + 0.8 * (place + 0.5) / len(lines) - 0.4
            marker = LOOKS["markers"][line.setting]
            look = {"marker": marker, "ms": 5, "ls": "none", "capsize": 2, **_look(line, place)}
            panel.errorbar(x, units.mean(), units.std(), **look)
        panel.set_xticks(range(len(names)), names)
        panel.grid(alpha=0.3)
    figure.legend(*panel.get_legend_handles_labels(), ncols=6, loc="outside upper center")
    figure.supxlabel("mean and standard deviation of the seeds", fontsize=8)
    return figure


def draw_guidance(records: Records) -> Figure:
    """Draw human seconds until a row learned, and its success: a panel a task, a dot a seed."""
    figure = Figure(figsize=(3.3 * len(plan.TASKS) + 1.5, 7.0), layout="constrained")
    panels = figure.subplots(2, len(plan.TASKS), sharey=True)
    heights = dict(zip(plan.ROWS, -np.arange(len(plan.ROWS)), strict=True))

    def dots(panel: Axes, row: str, values: Any, middle: float) -> None:
        height, colour = heights[row], "C3" if row == PHIL.algorithm else "C0"
        places = height + np.linspace(0.2, -0.2, len(values))
        panel.plot(values, places, "o", ms=4, alpha=0.55, mew=0, color=colour)
        panel.plot([middle] * 2, [height - 0.35, height + 0.35], lw=2, color=colour)

    for (above, below), task in zip(panels.T, plan.TASKS, strict=True):
        units = {row: records.of(task, Line(row, plan.GOOD)) for row in plan.ROWS}
        costly = (*plan.HELPED, *plan.SHOWN)
        learned = {row: units[row][f"human_s_to_{data.LEARNED:.0%}"] for row in costly}
        finite = [s for row in costly for s in learned[row] if s < np.inf]
        most = max(finite, default=1.0)
        never = 1.15 * most
        for row in plan.ROWS:
            success = 100.0 * units[row]["success nominal"]
            dots(below, row, success, success.mean())
            if row in costly:
                cut = learned[row].clip(upper=never)
                dots(above, row, cut, cut.quantile(interpolation="higher"))
        above.axvline(1.08 * most, color="0.6", lw=0.8, ls=":")
        above.text(never, 0.8, "never", ha="center", fontsize=8)
        above.set(title=plan.words(task), xlim=(0.0, 1.25 * most))
        above.set_xlabel(f"seconds of the human until {data.LEARNED:.0%} alone", fontsize=9)
        below.set(xlim=(-4.0, 104.0))
        below.set_xlabel("success, nominal tests, %", fontsize=9)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
        panel.set_yticks(list(heights.values()), [Line(row).name for row in plan.ROWS], fontsize=8)
        panel.set_ylim(heights[plan.ROWS[-1]] - 0.6, 1.6)
    return figure


FIGURES: Mapping[str, Mapping[str, Draw]] = {
    "paper": {
        **{name: partial(draw_curves, name)
           for name in ("fig7", "fig8", "fig11", "fig12", "fig13", "ablation", "printed")},
        "fig9": partial(draw_points, "fig9", [(SUCCESS, SUCCESS), (DISTANCE, DISTANCE)]),
        "fig10": partial(draw_points, "fig10", [(TIME_S, LATERAL)]),
        "fig14": partial(draw_points, "fig14", [(DISTANCE, DISTANCE)]),
        "fig15": partial(draw_points, "fig15", [(LONGITUDINAL, LATERAL)]),
    },
    "guidance": {"guidance": draw_guidance},
}  # fmt: skip
"""Study -> name of the figure's file, often an experiment's -> function that draws it."""
