"""The table of what each policy does in the tests, for results/README.md."""

from __future__ import annotations

from trainer.experiments.catalogue import NAMES, units_of
from trainer.experiments.claims.scenes import DISTANCE, SUCCESS, shown_of
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered, gather
from trainer.experiments.plan import SCENARIO_TITLES, SCENES
from trainer.experiments.store import Store
from trainer.experiments.summary import row

HEADER = ("units", "seeds", "nominal", "noise", "variant")


def unit_lines(store: Store, seeds: int) -> list[str]:
    """One row an algorithm and setting of which there is a unit; success and distance a scene."""
    gathered = gather(store, units_of(NAMES, seeds), seeds)
    kinds = dict.fromkeys((u.scenario, Line(u.algorithm, u.setting)) for u in gathered.found)
    lines = [row(HEADER), row(["---"] * len(HEADER))]
    for scenario in SCENARIO_TITLES:
        lines += [_line(gathered, scenario, line) for place, line in kinds if place == scenario]
    return lines


def _line(gathered: Gathered, scenario: str, line: Line) -> str:
    tests = [
        f"{shown_of(gathered, scene, line, SUCCESS)}, {shown_of(gathered, scene, line, DISTANCE)} m"
        for scene in SCENES
        if scene.scenario == scenario
    ]
    count = len(gathered.of(scenario, line.algorithm, line.setting))
    return row([f"{SCENARIO_TITLES[scenario]}, {line.label}", str(count), *tests])
