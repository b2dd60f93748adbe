"""One page that holds the results against the paper, and its figures.

A summary, a part for each experiment; figures 7 to 15, the ablation, the printed settings.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import median_high
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bridge.progress import ProgressBar
from bridge.report import markdown_table
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.experiments import data, plan
from trainer.experiments.claims import (
    AS_PRINTED,
    CLAIMS,
    GOALS,
    Claim,
    Comparison,
    judge_both,
)
from trainer.experiments.data import Line, Place, Result, Results, Scene, words
from trainer.experiments.plan import EXPERIMENTS, HUMAN_MODEL, NORMAL, PAPER_TESTS, SCENARIOS
from trainer.experiments.run import Store
from trainer.learner.config import ALGORITHMS
from trainer.pictures import write_figure
from trainer.training import metrics

COMMAND = "python -m trainer experiment"
PAPER_TABLES: dict[str, dict[str, tuple[str, ...]]] = {
    "table1": {
        "phil_td3": ("21.28±0.02", "21.27±0.02", "21.29±0.02"),
        "ia_td3": ("20.37±2.58", "19.75±3.05", "19.46±3.03"),
        "hi_td3": ("20.87±1.76", "20.63±1.74", "19.90±2.65"),
        HUMAN_MODEL: ("20.70±1.82", "20.88±1.32", "20.90±1.21"),
    },
    "table2": {
        "phil_td3": ("80.15±0.08", "79.26±4.30", "77.29±11.55"),
        "ia_td3": ("79.26±5.90", "78.64±6.11", "78.39±7.66"),
        "hi_td3": ("76.27±16.00", "76.02±13.72", "73.57±18.49"),
        HUMAN_MODEL: ("80.11±0.07", "77.66±12.27", "75.15±15.20"),
    },
}
"""Tables I and II of the paper: surviving distance, m, by scene."""
PAPER_S = dict(zip(plan.FOUR, (360.70, 348.71, 328.93, 329.39), strict=True))
"""The paper's table of time efficiency: seconds for 10,000 steps."""
EVERY_LINE = [Line(name, setting) for setting, names, *_ in plan.LINES for name in names]
"""Every line that is computed, in the order of work."""
Judged = tuple[Claim, Comparison, Comparison | None]
"""A claim with what was measured, and with the same of the policy alone."""


def _page(results: Results, store: Store) -> Iterator[str]:
    judged = [(claim, *judge_both(results, claim)) for claim in (*CLAIMS, *AS_PRINTED, *GOALS)]
    yield from _summary(results, store, judged)
    for name, experiment in EXPERIMENTS.items():
        title = f"{name}: {experiment.title}"
        yield from (f"## {title}", "", f"`{COMMAND} {name}`", "")
        if name in FIGURES:
            yield from (f"![{title}]({name}.png)", "")
        if name in PAPER_TABLES:
            yield from _distances(results, name)
        elif name in MORE:
            yield from MORE[name](results)
        rows = [
            (claim.text, claim.paper, f.text, f.holds, *((a.text, a.holds) if a else ()))
            for claim, f, a in judged
            if claim.source == name
        ]
        if rows:
            paper = "wanted" if name == "goals" else "the paper"
            head = ("claim", paper, "weakest comparison", "holds", "weakest, policy alone", "holds")
            yield from markdown_table(head[: len(rows[0])], rows)


def _summary(results: Results, store: Store, judged: Sequence[Judged]) -> Iterator[str]:
    wanted = len(plan.units_of(["all"], results.seeds))
    steps = " and ".join(f"{store.plan.steps[name]:,} in the {words(name)}" for name in SCENARIOS)
    yield from (
        "# The paper's experiments, run again",
        "",
        f"`{COMMAND} all --seeds {results.seeds}` computes what is missing, `{COMMAND} report` "
        "writes this page and its figures from `left_turn.jsonl` and `congestion.jsonl`, one line "
        f"a training. {len(results.found)} of {wanted} trainings and tests are there.",
        "",
        "What differs from the paper: highway-env's traffic stands in for CARLA's; the budget is "
        f"counted in environment steps, the same for every algorithm: {steps}, where the paper "
        "trains for 400 episodes; and the settings are this project's. What the paper's own give "
        f"is [printed](#{_anchor('printed')}).",
        "",
        *_ours(),
        f"The policy is validated alone every {store.plan.evaluate_every_steps} steps; the best "
        f"validated actor drives {store.plan.test_runs} test drives in each scene, of which the "
        f"first {PAPER_TESTS} have the paper's seeds.",
        "",
        "A comparison is decided where its 95 % interval lies on one side of its bar (0 where none "
        "is named): of a difference, paired by training seed, or of how many times as soon, by "
        "drawing seeds (∞: a line may never get there). A claim holds where all of its "
        "comparisons hold, or as many as are wanted. It does not, once too many fail. The "
        "weakest comparison of those that decide is shown. The intervals are over training seeds, "
        "in these scenes with these test drives. Learning curves "
        "are judged twice: as the paper does, on training episodes, in which a policy that the "
        "human saves arrives, too; and by the policy alone on validation drives.",
        "",
        "IA-TD3 is PHIL-TD3 without the Q advantage in its priorities. HI-TD3 does not imitate "
        "the human either. Vanilla TD3 has no human. RD2-TD3 and RD2-PHIL are IA-TD3 and PHIL-TD3 "
        "with a replay buffer for the human's transitions alone. The human is a model (DAgger, "
        "one frame) of the scripted expert, a single one in each scenario. The table says what "
        "kind of processor computed each; there the same seed has other bits.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""
    answers = {"yes": "holds", "no": "does not", "undecided": "undecided"}

    def counted(title: str, about: str, claims: Iterable[Judged]) -> Iterator[tuple[str, ...]]:
        its = [(found, alone) for _, found, alone in claims]
        if its:
            counts = (Counter(one.holds for one in each if one) for each in zip(*its, strict=True))
            cells = (f"{count[answer]}" if count else "" for count in counts for answer in answers)
            yield (title, about, *cells)

    rows = [*counted("all", "the paper's claims", (its for its in judged if its[0] in CLAIMS))]
    for name, one in EXPERIMENTS.items():
        its = (each for each in judged if each[0].source == name)
        rows += counted(f"[{name}](#{_anchor(name)})", one.title, its)
    head = ("", "about", *answers.values(), *(f"policy alone: {it}" for it in answers.values()))
    yield from markdown_table(head, rows)
    yield from markdown_table(
        ("setting", "meaning", "algorithms", "computed in"),
        (
            (
                words(setting),
                plan.SETTINGS[setting].meaning,
                ", ".join(Line(name).name for name in algorithms),
                computed_in(results, [Line(name, setting) for name in algorithms]),
            )
            for setting, algorithms, *_ in plan.LINES
            if HUMAN_MODEL not in algorithms
        ),
    )


def computed_in(results: Results, lines: Sequence[Line], tasks: Sequence[str] = SCENARIOS) -> str:
    """How many of the trainings multiplied in what, and where."""
    found = chain(*(results.of(*each) for each in product(tasks, lines)))
    counts = Counter(
        ("bfloat16" if its.get("bfloat16") else "float32") + " on a GPU" * bool(its.get("gpu"))
        for its in (one.record["computed"] for one in found)
    )
    return ", ".join(f"{count} {what}" for what, count in counts.most_common())


def _ours() -> Iterator[str]:
    """The settings that are not the paper's, as the presets have them."""
    ours, printed = (asdict(plan.PRESETS[name]) for name in ("ours", "printed"))
    for values in (ours, printed):
        values |= values.pop("learner")
    rows = [(f"`{name}`", f"{ours[name]}", f"{it}") for name, it in printed.items()]
    yield from markdown_table(("setting", "ours", "printed"), [r for r in rows if r[1] != r[2]])


def _anchor(name: str) -> str:
    """The link to the part of an experiment, as GitHub makes it."""
    return f"{name} {EXPERIMENTS[name].title}".lower().replace(",", "").replace(" ", "-")


def _times(results: Results) -> Iterator[str]:
    """The paper's table of time efficiency beside ours."""
    yield (
        "Seconds for 10,000 steps without validations, mean of the seeds. The trainings ran on "
        "several processors, beside others, which makes the intervals wide; `python -m trainer "
        "bench` measures the time of a step undisturbed."
    )
    yield ""
    ours = (results.estimate(SCENARIOS[0], Line(name), data.SECONDS).text(0) for name in PAPER_S)
    paper = (f"{seconds:.0f}" for seconds in PAPER_S.values())
    names = (Line(name).name for name in PAPER_S)
    yield from markdown_table(("", *names), [("the paper", *paper), ("ours", *ours)])


def _tests(results: Results) -> Iterator[str]:
    """Success of every policy in every scene."""
    yield (
        "Success in %, mean of the seeds, with its 95 % interval; in brackets that of the "
        f"paper's {PAPER_TESTS} seeds alone. {SCENE_KEY}."
    )
    yield ""
    rows = []
    for line in EVERY_LINE:
        cells = []
        for scene in data.SCENES:
            share = results.estimate(scene, line, data.SUCCESS).as_share()
            paper = results.pooled(scene, line, data.SUCCESS, paper=True)
            cells.append(f"{share} ({100 * paper.mean():.0f})" if len(paper) else "–")
        if set(cells) != {"–"}:
            rows.append((line.name, *cells))
    yield from markdown_table(("", *(scene.label for scene in data.SCENES)), rows)


def _distances(results: Results, name: str) -> Iterator[str]:
    """A table of the paper with our numbers beside its own."""
    yield (
        "Surviving distance, m, mean and standard deviation over the drives with the paper's "
        f"{PAPER_TESTS} seeds, of all trainings: ours (the paper's). Distances end at the goal, at "
        "21 and 80 m; the paper counts what was driven beyond it."
    )
    yield ""
    scenes = [scene for scene in data.PAPER_SCENES if scene.scenario in EXPERIMENTS[name].scenarios]
    rows = []
    for algorithm, numbers in PAPER_TABLES[name].items():
        cells = []
        for scene, number in zip(scenes, numbers, strict=True):
            ours = results.pooled(scene, Line(algorithm), data.DISTANCE, paper=True)
            shown = f"{ours.mean():.2f}±{ours.std():.2f}" if len(ours) else "–"
            cells.append(f"{shown} ({number})")
        rows.append((Line(algorithm).name, *cells))
    yield from markdown_table(("", *(scene.label for scene in scenes)), rows)


def _floor(results: Results) -> Iterator[str]:
    for scenario in SCENARIOS:
        for result in results.of(scenario, Line(plan.CONSTANT)):
            record = result.record
            action, success = f"{record['action']:g}", record["success_of"]
            yield (
                f"The best of {len(success)} constant actions in the {words(scenario)} is {action} "
                f"(of -1 to 1). It brings {success[action]:.0%} of {record['search'][0]} "
                f"validation drives to the goal, and {result.mean('nominal', data.SUCCESS):.0%} of "
                "the test drives."
            )
            yield ""


def _cost(results: Results) -> Iterator[str]:
    """Steps and human effort of every line, and how much of the best policy is left at the end."""
    yield (
        "Environment steps, and seconds that the human drove, until the policy alone reaches "
        f"{LEARNED:.0%} or {WELL:.0%} of its validation drives: median of the seeds, the least and "
        "the most of them (∞: never), and how many get there if not all do. The rest are means. "
        "Validation lost "
        f"at the end: the mean of the last {data.END_STEPS:,} steps against the best, which chance "
        "makes better, too."
    )
    yield ""
    yield from table(
        results, [(where, its) for its, where in product(EVERY_LINE, SCENARIOS)], COSTS
    )


Cell = Callable[[Sequence[Result]], str]
"""What stands in a table's column, for the trainings of one line in one task."""


def table(
    results: Results,
    places: Iterable[tuple[str, Line]],
    columns: Mapping[str, Cell],
    with_tested_only: bool = False,
) -> Iterator[str]:
    """A row for each task and line of which there is something; untrained ones if asked."""
    found = ((*place, results.of(*place)) for place in places)
    rows = [
        (line.name, words(task), *(cell(its) for cell in columns.values()))
        for task, line, its in found
        if its and (with_tested_only or its[0].unit.trained)
    ]
    return markdown_table(("", "scenario", *columns), rows)


def until(level: float, what: str) -> Cell:
    """A cost until the policy alone reached a level: median, least and most of the seeds.

    A seed that never does costs more than any other. In brackets, how many do if not all.
    """

    def cell(found: Sequence[Result]) -> str:
        costs = [getattr(cost, what) if (cost := one.until(level)) else np.inf for one in found]
        there = int(np.isfinite(costs).sum())
        if what in HUMAN_COSTS and not ALGORITHMS[found[0].unit.algorithm].guided:
            return "–"
        if not there:
            return "never"
        return spread(costs) + (f" ({there} of {len(costs)})" if there < len(costs) else "")

    return cell


def mean(number: Callable[[Result], float], digits: int = 0) -> Cell:
    """The mean of the seeds."""
    return lambda found: f"{np.mean([number(one) for one in found]):,.{digits}f}"


def spread(numbers: Sequence[float]) -> str:
    """Median (of an even number the upper middle), least and most, as in "12 [8, ∞]".

    Of five, 15 of 16 times the true median lies between the least and the most.
    """
    ends = (f"{number:,.0f}" for number in (median_high(numbers), min(numbers), max(numbers)))
    middle, least, most = ("0" if end == "-0" else end.replace("inf", "∞") for end in ends)
    return f"{middle} [{least}, {most}]"


LEARNED, WELL = metrics.LEARNED
"""Success of the policy alone at which it counts as learned, and as learned well."""
HUMAN_COSTS = ("human_s", "takeovers")
STEPS = f"steps to {LEARNED:.0%}"
S_TO_LEARNED, S_TO_WELL = (f"human s to {level:.0%}" for level in (LEARNED, WELL))
COSTS: Mapping[str, Cell] = {
    "seeds": lambda found: f"{len(found)}",
    STEPS: until(LEARNED, "steps"),
    S_TO_LEARNED: until(LEARNED, "human_s"),
    S_TO_WELL: until(WELL, "human_s"),
    "validation lost at the end, points": mean(lambda one: 100 * one.unlearned, 1),
    "by the worst seed": lambda found: f"{100 * max(one.unlearned for one in found):.1f}",
    "human steps": mean(lambda one: one.costs.human_steps),
    "take-overs": mean(lambda one: one.costs.takeovers),
    "failures": mean(lambda one: one.costs.failures),
    "updates": mean(lambda one: one.record["totals"]["updates"]),
}
"""The columns of ``cost``."""
MORE = {"fig9": _tests, "time": _times, "floor": _floor, "cost": _cost}
"""Experiment -> its tables beside its claims."""


COLOURS = {"phil_td3": "C3", "ia_td3": "C0", "hi_td3": "C2", "per_td3": "C7", HUMAN_MODEL: "C1"}
OTHERS = ("C4", "C5", "C6", "C8", "C9", "black", "C1")
"""For algorithms without a colour of their own, by their place in the figure."""
CURVES = (
    (data.TRAINING, data.REWARD),
    (data.TRAINING, data.DISTANCE),
    (data.ALONE, data.SUCCESS),
    (data.ALONE, data.DISTANCE),
)
TITLES = {
    data.REWARD: "reward",
    data.DISTANCE: "surviving distance, m",
    data.SUCCESS: "success",
    data.TIME_S: "time to the goal, s",
    data.LATERAL: "mean |lateral acceleration|, m/s²",
    data.LONGITUDINAL: "mean |longitudinal acceleration|, m/s²",
}
MARKERS = {"normal": "o", "one_frame": "D", "random": "^", "biased": "v"}
SCENE_KEY = "L: left turn, C: congestion, -N: command noise, -V: variant, -D: dense"
Panel = tuple[Sequence[Place], str, str]
"""Side by side in a panel: the places, their quantity, and the kind of their curves."""


def colour(line: Line, place: int = 0) -> str:
    """An algorithm's colour, the same in every figure."""
    return COLOURS.get(line.algorithm, OTHERS[place % len(OTHERS)])


def _marked(line: Line, place: int) -> dict[str, Any]:
    """A point of an algorithm: its colour, and a shape for the setting; hollow but in normal."""
    own = colour(line, place)
    filled = own if line.setting == NORMAL else "white"
    return {"marker": MARKERS[line.setting], "color": own, "mfc": filled, "ms": 5, "ls": "none"}


def lines_of(name: str) -> list[Line]:
    """The lines of an experiment, an algorithm's settings side by side."""
    one = EXPERIMENTS[name]
    return [Line(*each) for each in product(one.algorithms, one.settings)]


def draw_curves(results: Results, lines: Sequence[Line]) -> Figure:
    """A row a scenario: training episodes with the human's help, then the policy alone."""
    figure = Figure(figsize=(16.0, 6.8), layout="constrained")
    panels = figure.subplots(2, len(CURVES), sharex="row")
    for panel, (scenario, (kind, metric)) in zip(
        panels.flat, product(SCENARIOS, CURVES), strict=True
    ):
        panel.set_title(f"{words(scenario)}: {TITLES[metric]}, {kind}", fontsize=10)
        for place, line in enumerate(lines):
            found = results.of(scenario, line)
            if not found or (metric == data.REWARD and line.setting == "printed"):
                continue  # the printed reward is on another scale
            curves, grid = np.stack([result.curve(kind, metric) for result in found]), found[0].grid
            mean, std = curves.mean(axis=0), curves.std(axis=0, ddof=min(len(curves) - 1, 1))
            look = {"ls": "-" if line.setting == NORMAL else "--", "color": colour(line, place)}
            panel.plot(grid, mean, **look, lw=1.8, label=f"{line.name}, seeds: {len(found)}")
            band = mean - std, mean + std
            panel.fill_between(grid, *band, color=look["color"], alpha=0.15, lw=0)
        if metric != data.REWARD:
            best = 1.0 if metric == data.SUCCESS else plan.FULL_PATH_M[scenario]
            panel.axhline(best, color="0.6", lw=0.8, ls=":")
            panel.set_ylim(top=1.05 * best)
        panel.grid(alpha=0.3)
        if (kind, metric) == CURVES[-1] and panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.supxlabel(
        "environment steps; in training: episodes in which the human may take over; "
        "alone: validation drives without help; band: standard deviation over the seeds",
        fontsize=9,
    )
    return figure


def draw_groups(
    results: Results, lines: Sequence[Line], panels: Sequence[Panel], rows: int
) -> Figure:
    """The lines side by side in each place of each panel: points are means of the seeds; boxes, of
    what is compared of arrivals only, are of the drives of all seeds that arrive.
    """
    figure = Figure(figsize=(15.0, 1.8 + 2.8 * rows), layout="constrained")
    axes, width = figure.subplots(rows, len(panels) // rows), 0.8 / len(lines)
    for axis, (places, quantity, kind) in zip(axes.flat, panels, strict=True):
        first = places[0]
        where = words(first.scenario) if isinstance(first, Scene) else kind
        axis.set_title(f"{TITLES[quantity]}, {where}", fontsize=10)
        for (group, place), (side, line) in product(enumerate(places), enumerate(lines)):
            x = group + (side - 0.5 * (len(lines) - 1)) * width
            look = _marked(line, side)
            if isinstance(place, Scene) and quantity in data.ARRIVED_ONLY:
                arrived = results.pooled(place, line, data.SUCCESS) > 0.0
                values = results.pooled(place, line, quantity)[arrived]
                if len(values):
                    axis.boxplot(
                        [values], positions=[x], widths=0.85 * width, patch_artist=True,
                        boxprops={"fc": look["mfc"], "ec": look["color"]}, showfliers=False,
                        medianprops={"color": "black"},
                    )  # fmt: skip
            else:
                values = np.array([*results.numbers(place, line, quantity, kind).values()])
                if len(values):
                    std = values.std(ddof=1) if len(values) > 1 else None
                    axis.errorbar(x, values.mean(), std, capsize=2, **look)
        axis.set_xticks(range(len(places)), [words(place) for place in places], fontsize=8)
        axis.set_xlim(-0.6, len(places) - 0.4)
        axis.grid(alpha=0.3)
        axis.set_axisbelow(True)
    handles = [Line2D([], [], label=line.name, **_marked(line, n)) for n, line in enumerate(lines)]
    figure.legend(handles=handles, fontsize=8, ncols=6, loc="outside upper center")
    (first, *_), quantity, _ = panels[0]
    boxes = quantity in data.ARRIVED_ONLY
    shown = "drives that arrive" if boxes else "points: mean and standard deviation of the seeds"
    key = f"{SCENE_KEY}; " if isinstance(first, Scene) else ""
    figure.supxlabel(key + shown, fontsize=8)
    return figure


def _scenes(*quantities: Sequence[str], of: Iterable[Scene] = data.SCENES) -> list[Panel]:
    """A panel for each scenario's scenes, with a quantity for each scenario."""
    scenes = list(of)
    return [
        ([scene for scene in scenes if scene.scenario == scenario], quantity, data.ALONE)
        for pair in quantities
        for scenario, quantity in zip(SCENARIOS, pair, strict=True)
    ]


ENDS: list[Panel] = [
    ([scenario], metric, kind) for scenario, (kind, metric) in product(SCENARIOS, CURVES)
]
"""Where the curves end."""
GROUPS: Mapping[str, tuple[list[Panel], int]] = {
    "fig8": (ENDS, 2),
    "fig9": (_scenes((data.SUCCESS, data.SUCCESS), (data.DISTANCE, data.DISTANCE)), 2),
    "fig10": (_scenes((data.TIME_S, data.LATERAL)), 1),
    "fig14": (_scenes((data.DISTANCE, data.DISTANCE), of=data.PAPER_SCENES), 1),
    "fig15": (_scenes((data.LONGITUDINAL, data.LATERAL), of=data.PAPER_SCENES), 1),
}
"""Figure -> its panels and their rows."""
FIGURES: Mapping[str, Callable[[Results], Figure]] = {
    **{
        name: partial(draw_curves, lines=lines_of(name))
        for name in ("fig7", "fig11", "fig12", "fig13", "ablation", "printed")
    },
    **{
        name: partial(draw_groups, lines=lines_of(name), panels=panels, rows=rows)
        for name, (panels, rows) in GROUPS.items()
    },
}
"""Name of the experiment, and of the PNG -> how it is drawn."""


def write_report(
    store: Store,
    seeds: int,
    name: str = "all",
    figures: Mapping[str, Callable[[Results], Figure]] = FIGURES,
    page: Callable[[Results, Store], Iterator[str]] = _page,
) -> Path:
    """Draw all figures and write the page beside the records; returns its path.

    Raises UserError: there are no records at all.
    """
    results = data.load(store, seeds, name)
    if not results.found:
        raise UserError(f"there are no results to report in {store.results}")
    with ProgressBar("report", len(figures)) as bar:
        for title, draw in figures.items():
            write_figure(draw(results), store.results / f"{title}.png")
            bar.advance({"drawn": title})
    path = store.results / "README.md"
    write_atomic(path, ("\n".join(page(results, store)) + "\n").encode())
    return path
