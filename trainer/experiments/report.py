"""One page that holds the results against the paper: claims, bars, tables and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.experiments.claims import Judged, judge, judge_bars
from trainer.experiments.data import (
    ALONE,
    DISTANCE,
    PAPER_SCENES,
    SCENES,
    SECONDS,
    SUCCESS,
    Line,
    Results,
    load,
    words,
)
from trainer.experiments.figures import FIGURES, write_figure
from trainer.experiments.judges import Finding, steps_to
from trainer.experiments.plan import (
    CONSTANT,
    EXPERIMENTS,
    FOUR,
    HUMAN_MODEL,
    LINES,
    PAPER_TESTS,
    SCENARIOS,
    SETTINGS,
    units_of,
)
from trainer.experiments.statistics import mean_estimate
from trainer.experiments.store import Store

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
PAPER_S = dict(zip(FOUR, (360.70, 348.71, 328.93, 329.39), strict=True))
"""The paper's table of time efficiency: seconds for 10,000 steps."""
EVERY_LINE = [Line(name, setting) for _, setting, names in LINES for name in names]
"""Every line that is computed, in the order of work."""
COSTS = ("episodes", "steps", "updates", "human_steps", "takeovers")
"""Of a record's totals, those that the page shows as they are."""


def write_report(store: Store, seeds: int) -> Path:
    """Draw all figures and write the page beside the records; returns its path.

    Raises:
        UserError: there are no records at all.
    """
    results = load(store, seeds)
    if not results.found:
        raise UserError(f"there are no results to report in {store.results}")
    for name, draw in FIGURES.items():
        write_figure(draw(results), store.results / f"{name}.png")
    path = store.results / "README.md"
    write_atomic(path, ("\n".join(_page(results, store)) + "\n").encode())
    return path


def _page(results: Results, store: Store) -> Iterator[str]:
    judged, bars = list(judge(results)), list(judge_bars(results))
    yield from _introduction(results, judged, bars)
    yield from _section(
        "The paper's claims", "report",
        "A verdict is yes or no where a 95 % interval of the difference, paired by training seed, "
        "lies on one side of the bar; else it is undecided. What decides is the worst of the "
        "comparisons that a claim makes. Learning curves are judged twice: as the paper does, on "
        "training episodes in which the human helps, and by the policy alone on validation drives.",
    )  # fmt: skip
    yield from table(
        ("", "claim", "the paper", "what decides", "holds", "policy alone", "holds"),
        (
            (f"[{claim.source}](#{_anchor(claim.source)})", claim.text, claim.paper, found.ours,
             found.holds, *((alone.ours, alone.holds) if alone else ("", "")))
            for claim, found, alone in judged
        ),
    )  # fmt: skip
    yield from _times(results)
    yield from _section(
        "This project's bars", "report",
        "Of the policy alone: means of the seeds decide about shares and steps, 95 % intervals "
        "about which one is ahead.",
    )  # fmt: skip
    yield from table(("bar", "measured", "met"), ((t, f.ours, f.holds) for t, f in bars))
    yield from _tests(results)
    for name, scenario in zip(PAPER_TABLES, SCENARIOS, strict=True):
        yield from _paper_table(results, name, scenario)
    yield from _costs(results)
    for name in FIGURES:
        title = EXPERIMENTS[name].title
        yield from _section(f"{name}: {title}", name, f"![{title}]({name}.png)")


def _introduction(
    results: Results, judged: Sequence[Judged], bars: Sequence[tuple[str, Finding]]
) -> Iterator[str]:
    wanted = units_of(["all"], results.seeds)
    holds, met = Counter(one.found.holds for one in judged), Counter(f.holds for _, f in bars)
    budgets = " and ".join(f"{results.budget(name):,} in the {words(name)}" for name in SCENARIOS)
    yield from (
        "# The paper's experiments, run again",
        "",
        f"`{COMMAND} all --seeds {results.seeds}` computes what is missing, `{COMMAND} report` "
        "writes this page and its figures from `left_turn.jsonl` and `congestion.jsonl`, one line "
        f"a training. {len(results.found)} of {len(wanted)} trainings and tests are there.",
        "",
        f"Every algorithm has the same budget of environment steps: {budgets}. The policy is "
        "validated alone every 500 steps; the best validated actor drives 250 test drives in each "
        f"scene, of which the first {PAPER_TESTS} have the paper's seeds.",
        "",
        f"Of the paper's {len(judged)} claims {holds['yes']} hold, {holds['no']} do not, and "
        f"{holds['undecided']} are undecided. Of this project's {len(bars)} bars {met['yes']} are "
        f"met, {met['no']} are not, {met['undecided']} are undecided.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""
    yield from table(
        ("setting", "meaning", "algorithms"),
        (
            (name, SETTINGS[name].meaning, ", ".join(Line(a).name for a in algorithms))
            for _, name, algorithms in LINES
            if HUMAN_MODEL not in algorithms
        ),
    )


def _anchor(source: str) -> str:
    """The link to the section of an experiment, as GitHub makes it."""
    title = f"{source} {EXPERIMENTS[source].title}".lower().replace(",", "")
    return title.replace(" ", "-")


def _times(results: Results) -> Iterator[str]:
    """The paper's table of time efficiency beside ours."""
    yield from _section(
        "time: training time", "time",
        "Seconds for 10,000 steps without validations, mean of the seeds. Trainings share their "
        "machine with others; `trainer bench` measures the time of a step in turns.",
    )  # fmt: skip
    ours = {
        name: mean_estimate(results.numbers(SCENARIOS[0], Line(name), SECONDS).values())
        for name in PAPER_S
    }
    yield from table(
        ("", *(Line(name).name for name in PAPER_S)),
        (
            ("the paper", *(f"{each:.0f}" for each in PAPER_S.values())),
            ("ours", *(each.text(0) for each in ours.values())),
        ),
    )


def _tests(results: Results) -> Iterator[str]:
    """Success of every policy in every scene."""
    yield from _section(
        "Test drives", "fig9 fig14 printed floor",
        "Success in %, mean of the seeds, with its 95 % interval; in brackets that of the "
        f"paper's {PAPER_TESTS} seeds alone.",
    )  # fmt: skip
    rows = []
    for line in EVERY_LINE:
        cells = []
        for scene in SCENES:
            found = mean_estimate(results.numbers(scene, line, SUCCESS).values())
            paper = results.pooled(scene, line, SUCCESS, paper=True)
            shown = f"{found.as_share()} ({100 * paper.mean():.0f})" if len(paper) else "–"
            cells.append(shown)
        if set(cells) != {"–"}:
            rows.append((line.name, *cells))
    yield from table(("", *(scene.label for scene in SCENES)), rows)


def _paper_table(results: Results, name: str, scenario: str) -> Iterator[str]:
    """A table of the paper with our numbers beside its own."""
    yield from _section(
        f"{name}: {EXPERIMENTS[name].title}", name,
        "Surviving distance, m, mean and standard deviation over the drives with the paper's "
        f"{PAPER_TESTS} seeds, of all trainings: ours (the paper's). Distances end at the goal, at "
        "21 and 80 m; the paper counts what was driven beyond it.",
    )  # fmt: skip
    scenes = [scene for scene in PAPER_SCENES if scene.scenario == scenario]
    rows = []
    for algorithm, numbers in PAPER_TABLES[name].items():
        cells = []
        for scene, number in zip(scenes, numbers, strict=True):
            ours = results.pooled(scene, Line(algorithm), DISTANCE, paper=True)
            shown = f"{ours.mean():.2f}±{ours.std():.2f}" if len(ours) else "–"
            cells.append(f"{shown} ({number})")
        rows.append((Line(algorithm).name, *cells))
    yield from table(("", *(scene.label for scene in scenes)), rows)


def _costs(results: Results) -> Iterator[str]:
    """What each training cost, and where the policy alone ends."""
    yield from _section(
        "What the trainings cost", "all",
        "Means of the seeds. Alone: validation drives of the policy without help.",
    )  # fmt: skip
    rows = []
    for scenario in SCENARIOS:
        for line in EVERY_LINE:
            found = results.of(scenario, line)
            if not found or not found[0].unit.trained:
                continue
            totals = [result.record["totals"] for result in found]
            costs = [f"{np.mean([each[key] for each in totals]):,.0f}" for key in COSTS]
            failures = np.mean([sum(each["failures"].values()) for each in totals])
            reached = steps_to(found, 0.9)
            best = np.mean([each["validation"]["best"] for each in totals])
            end = np.mean([*results.numbers(scenario, line, SUCCESS, ALONE).values()])
            rows.append((
                words(scenario), line.name, str(len(found)), *costs, f"{failures:.0f}",
                f"{reached:,.0f}" if np.isfinite(reached) else "never",
                f"{100 * best:.0f} %", f"{100 * end:.0f} %",
            ))  # fmt: skip
    yield from table(
        ("", "", "seeds", "episodes", "steps", "updates", "human steps", "take-overs", "failures",
         "steps to 90 % alone", "best alone", "end alone"), rows)  # fmt: skip
    for scenario in SCENARIOS:
        for result in results.of(scenario, Line(CONSTANT)):
            action, tried = result.record["action"], len(result.record["success_of"])
            best = f"{action:g}, the best of {tried} on validation drives."
            yield from (f"Best constant action in the {words(scenario)}: {best}", "")


def _section(title: str, names: str, text: str = "") -> Iterator[str]:
    """A heading, the command that computes what is below it, and a paragraph."""
    yield from (f"## {title}", "", f"`{COMMAND} {names}`", "")
    if text:
        yield from (text, "")


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    """A Markdown table and an empty line."""
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(str(cell).replace('|', '/') for cell in row)} |"
    yield ""
