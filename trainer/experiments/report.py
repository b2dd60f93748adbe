"""One page that holds the results against the paper: a summary, and a part for each experiment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from bridge.report import markdown_table
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.experiments.claims import CLAIMS, Claim, Finding, judge_both
from trainer.experiments.data import (
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
Judged = tuple[Claim, Finding, Finding | None]
"""A claim with what was measured, and with the same of the policy alone."""


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
    judged = [(claim, *judge_both(results, claim)) for claim in CLAIMS]
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
            (claim.text, claim.paper, f.ours, f.holds, *((a.ours, a.holds) if a else ("", "")))
            for claim, f, a in judged
            if claim.source == name
        ]
        if rows:
            head = ("claim", "the paper", "what decides", "holds", "policy alone", "holds")
            yield from markdown_table(head, rows)


def _summary(results: Results, store: Store, judged: Sequence[Judged]) -> Iterator[str]:
    wanted = len(units_of(["all"], results.seeds))
    steps = " and ".join(f"{store.plan.steps[name]:,} in the {words(name)}" for name in SCENARIOS)
    yield from (
        "# The paper's experiments, run again",
        "",
        f"`{COMMAND} all --seeds {results.seeds}` computes what is missing, `{COMMAND} report` "
        "writes this page and its figures from `left_turn.jsonl` and `congestion.jsonl`, one line "
        f"a training. {len(results.found)} of {wanted} trainings and tests are there.",
        "",
        f"Every algorithm has the same budget of environment steps: {steps}. The policy is "
        f"validated alone every {store.plan.evaluate_every_steps} steps; the best validated actor "
        f"drives {store.plan.test_runs} test drives in each scene, of which the first "
        f"{PAPER_TESTS} have the paper's seeds.",
        "",
        "A claim holds or does not where a 95 % interval of the difference, paired by training "
        "seed, lies on one side; else it is undecided. What decides is the worst of the "
        "comparisons that it makes. Learning curves are judged twice: as the paper does, on "
        "training episodes in which the human helps, and by the policy alone on validation drives.",
        "",
    )
    if results.stale:
        yield f"{len(results.stale)} records are of other settings than today's and left out."
        yield ""
    counts: Counter[tuple[str, str]] = Counter(
        (claim.source, found.holds) for claim, found, _ in judged
    )
    answers = ("yes", "no", "undecided")
    rows = [
        (f"[{name}](#{_anchor(name)})", one.title, *(counts[name, answer] for answer in answers))
        for name, one in EXPERIMENTS.items()
    ]
    totals = (sum(counts[name, answer] for name in EXPERIMENTS) for answer in answers)
    yield from markdown_table(("", "about", *answers), [*rows, ("all", "", *totals)])
    yield from markdown_table(
        ("setting", "meaning", "algorithms"),
        (
            (name, SETTINGS[name].meaning, ", ".join(Line(a).name for a in algorithms))
            for _, name, algorithms in LINES
            if HUMAN_MODEL not in algorithms
        ),
    )


def _anchor(name: str) -> str:
    """The link to the part of an experiment, as GitHub makes it."""
    return f"{name} {EXPERIMENTS[name].title}".lower().replace(",", "").replace(" ", "-")


def _times(results: Results) -> Iterator[str]:
    """The paper's table of time efficiency beside ours."""
    yield (
        "Seconds for 10,000 steps without validations, mean of the seeds. Trainings share their "
        "machine with others; `python -m trainer bench` measures the time of a step undisturbed."
    )
    yield ""
    ours = (results.estimate(SCENARIOS[0], Line(name), SECONDS).text(0) for name in PAPER_S)
    paper = (f"{seconds:.0f}" for seconds in PAPER_S.values())
    names = (Line(name).name for name in PAPER_S)
    yield from markdown_table(("", *names), [("the paper", *paper), ("ours", *ours)])


def _tests(results: Results) -> Iterator[str]:
    """Success of every policy in every scene."""
    yield (
        "Success in %, mean of the seeds, with its 95 % interval; in brackets that of the "
        f"paper's {PAPER_TESTS} seeds alone."
    )
    yield ""
    rows = []
    for line in EVERY_LINE:
        cells = []
        for scene in SCENES:
            share = results.estimate(scene, line, SUCCESS).as_share()
            paper = results.pooled(scene, line, SUCCESS, paper=True)
            cells.append(f"{share} ({100 * paper.mean():.0f})" if len(paper) else "–")
        if set(cells) != {"–"}:
            rows.append((line.name, *cells))
    yield from markdown_table(("", *(scene.label for scene in SCENES)), rows)


def _distances(results: Results, name: str) -> Iterator[str]:
    """A table of the paper with our numbers beside its own."""
    yield (
        "Surviving distance, m, mean and standard deviation over the drives with the paper's "
        f"{PAPER_TESTS} seeds, of all trainings: ours (the paper's). Distances end at the goal, at "
        "21 and 80 m; the paper counts what was driven beyond it."
    )
    yield ""
    scenes = [scene for scene in PAPER_SCENES if scene.scenario in EXPERIMENTS[name].scenarios]
    rows = []
    for algorithm, numbers in PAPER_TABLES[name].items():
        cells = []
        for scene, number in zip(scenes, numbers, strict=True):
            ours = results.pooled(scene, Line(algorithm), DISTANCE, paper=True)
            shown = f"{ours.mean():.2f}±{ours.std():.2f}" if len(ours) else "–"
            cells.append(f"{shown} ({number})")
        rows.append((Line(algorithm).name, *cells))
    yield from markdown_table(("", *(scene.label for scene in scenes)), rows)


def _floor(results: Results) -> Iterator[str]:
    for scenario in SCENARIOS:
        for result in results.of(scenario, Line(CONSTANT)):
            action, tried = result.record["action"], len(result.record["success_of"])
            yield f"Best in the {words(scenario)}: {action:g}, of {tried} on validation drives."
            yield ""


MORE = {"fig9": _tests, "time": _times, "floor": _floor}
"""Experiment -> its tables beside its claims."""
