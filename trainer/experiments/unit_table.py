"""The table of what each policy does in the tests, for results/README.md."""

from __future__ import annotations

from collections.abc import Sequence

from trainer.experiments.catalogue import NAMES, units_of
from trainer.experiments.claims.scenes import DISTANCE, SUCCESS, shown_of
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered, gather
from trainer.experiments.outcome import Outcome
from trainer.experiments.plan import DENSE_SCENES, NETWORK, SCENARIO_TITLES, SCENES, Scene
from trainer.experiments.store import Store
from trainer.experiments.summary import row

REMARKS = {NETWORK: " (tested without it)"}
"""What a setting's name would let one believe."""


def unit_lines(store: Store, seeds: int) -> list[str]:
    """One row an algorithm and setting of which there is a unit: success and distance a scene in
    which any was tested, and the success without help that chose the tested actor, beside that of
    the last one.
    """
    gathered = gather(store, units_of(NAMES, seeds), seeds)
    kinds = dict.fromkeys((u.scenario, Line(u.algorithm, u.setting)) for u in gathered.found)
    tested = {condition for outcome in gathered.found.values() for condition in outcome.tests}
    scenes = [scene for scene in (*SCENES, *DENSE_SCENES) if scene.condition in tested]
    conditions = dict.fromkeys(scene.condition for scene in scenes)
    header = ("units", "seeds", *conditions, "validated: best → last")
    lines = [row(header), row(["---"] * len(header))]
    for scenario in SCENARIO_TITLES:
        there = [scene for scene in scenes if scene.scenario == scenario]
        lines += [_line(gathered, scenario, there, line) for s, line in kinds if s == scenario]
    return lines


def _line(gathered: Gathered, scenario: str, scenes: Sequence[Scene], line: Line) -> str:
    tests = [
        f"{shown_of(gathered, scene, line, SUCCESS)}, {shown_of(gathered, scene, line, DISTANCE)} m"
        for scene in scenes
    ]
    outcomes = gathered.of(scenario, line.algorithm, line.setting)
    name = f"{SCENARIO_TITLES[scenario]}, {line.label}{REMARKS.get(line.setting, '')}"
    return row([name, str(len(outcomes)), *tests, _validated(outcomes)])


def _validated(outcomes: Sequence[Outcome]) -> str:
    """Each seed's best and last success in validation, in percent."""
    measured = [o.measured("validation_success")[1] for o in outcomes if o.unit.trained]
    shown = [f"{100 * shares.max():.0f} → {100 * shares[-1]:.0f}" for shares in measured]
    return f"{', '.join(shown)} %" if shown else "–"
