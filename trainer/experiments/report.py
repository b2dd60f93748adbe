"""From the store to figures, verdicts and the table of what is done."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from edge_runtime.files import make_directory
from trainer.experiments import timing
from trainer.experiments.catalogue import EXPERIMENTS, NAMES, TIME
from trainer.experiments.figures.style import write_figure
from trainer.experiments.gathered import Gathered, gather
from trainer.experiments.store import BEGUN, DONE, IMPOSSIBLE, MISSING, RUNNING, Store
from trainer.experiments.units import Unit, obstacle
from trainer.experiments.verdict import Verdict, verdict_of, write_verdict

STATES = (DONE, RUNNING, BEGUN, MISSING, IMPOSSIBLE)
TIME_TITLE = "training time of the algorithms"


def directory_of(store: Store, name: str) -> Path:
    """Where an experiment's figure and verdict are."""
    return store.results / "experiments" / name


def draw_experiment(
    store: Store, name: str, seeds: int, device: str = "cpu", draw_only: bool = True
) -> Verdict:
    """Draw and judge an experiment from what the store has, however little that is."""
    directory = directory_of(store, name)
    make_directory(directory)
    figure_file = f"{name}.png"
    if name == TIME:
        turns = timing.load_or_measure(directory, store.plan, store.humans, device, draw_only)
        gathered = Gathered([], {}, seeds)
        figure, claims, title = timing.draw(turns), timing.judge(turns), TIME_TITLE
    else:
        experiment = EXPERIMENTS[name]
        gathered = gather(store, experiment.units(seeds), seeds)
        figure, claims = experiment.draw(gathered), experiment.judge(gathered)
        title = experiment.title
    write_figure(figure, directory / figure_file)
    verdict = verdict_of(name, title, claims, gathered, figure_file)
    write_verdict(verdict, directory)
    return verdict


def outcome_line(verdict: Verdict, directory: Path) -> str:
    """What an experiment came to, in one line."""
    holds = Counter(one.holds for one in verdict.claims)
    said = ", ".join(f"{holds[word]} {word}" for word in ("yes", "no", "undecided") if holds[word])
    units = ""
    if verdict.wanted:
        units = f"{verdict.wanted - len(verdict.missing)} of {verdict.wanted} units; "
    return f"{verdict.name}: {units}claims: {said}: {directory}"


def warn_of_obstacles(store: Store, units: Iterable[Unit]) -> list[Unit]:
    """The units that this version can compute; each reason why others cannot is said once."""
    possible, reasons = [], Counter[str]()
    for unit in units:
        reason = obstacle(unit, store.humans)
        if reason is None:
            possible.append(unit)
        else:
            reasons[reason] += 1
    for reason, count in reasons.items():
        print(f"left out: {count} units, since {reason}", file=sys.stderr)
    return possible


def print_status(store: Store, names: Sequence[str], seeds: int) -> None:
    """A table on stdout: how many units of each experiment are in which state."""
    table = Table("experiment", *STATES, title=f"units with {seeds} seeds")
    states: dict[Unit, str] = {}
    for name in (name for name in NAMES if name in names and name != TIME):
        units = EXPERIMENTS[name].units(seeds)
        for unit in units:
            if unit not in states:
                states[unit] = store.state(unit)
        table.add_row(name, *_counts(states[unit] for unit in units))
    table.add_section()
    table.add_row("all, each once", *_counts(states.values()))
    if TIME in names:
        measured = (directory_of(store, TIME) / timing.MEASURED_FILE).is_file()
        table.add_row(TIME, "measured" if measured else "-", "", "", "" if measured else "1", "")
    Console().print(table)
    for unit in (unit for unit in states if states[unit] == RUNNING):
        print(f"running: {unit}, {store.holder(unit)}")
    warn_of_obstacles(store, states)


def _counts(states: Iterable[str]) -> list[str]:
    found = Counter(states)
    return [str(found[state] or "-") for state in STATES]
