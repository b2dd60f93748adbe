"""What this project asks of test drives: decided by the mean of all seeds, not by an interval."""

from __future__ import annotations

from collections.abc import Sequence

from trainer.experiments.claims.compare import BY_VALUE
from trainer.experiments.claims.lines import HUMAN, PHIL
from trainer.experiments.claims.scenes import (
    DISTANCE,
    SUCCESS,
    path_by_seed,
    shown_of,
    success,
    success_by_seed,
    tested_all,
)
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import FULL_PATH_M, Scene
from trainer.experiments.statistics import Estimate, mean_estimate
from trainer.experiments.verdict import BAR, Claim, claim

ROUNDING = 1e-9
"""Of a mean of means, which a tie must survive."""
SUCCESS_BARS = {"L": 1.0, "L-N": 0.98, "L-V": 0.96, "C": 0.98, "C-N": 0.96, "C-V": 0.92}
"""Least success of PHIL-TD3 in each scene."""
WHAT = {SUCCESS: "success", DISTANCE: "surviving distance"}


def success_bar(gathered: Gathered, scene: Scene) -> Claim:
    """Mean success of all seeds, each of which is shown."""
    outcomes = gathered.tested(scene, PHIL.algorithm)
    least = SUCCESS_BARS[scene.label]
    everything = success(outcomes, scene.condition)
    return claim(
        f"{scene.title}: {BAR}, success of PHIL-TD3 at least {least:.0%}",
        "highest of all",
        f"{shown_of(gathered, scene, PHIL, SUCCESS)}, all drives {everything.text()}",
        "yes" if everything.value >= least else "no",
        len(outcomes),
        f"{BY_VALUE}; Wilson's interval, as if all drives were independent, shown",
        everything,
        tested_all(gathered, scene, [PHIL]),
    )


def first_bar(gathered: Gathered, scene: Scene, quantity: str, others: Sequence[Line]) -> Claim:
    """Whether PHIL-TD3 is the first of all; the order of all is shown, with intervals."""
    text = f"{scene.title}: {BAR}, PHIL-TD3 is the first in {WHAT[quantity]}"
    return _ahead(gathered, scene, quantity, others, text)


def human_bar(gathered: Gathered, scene: Scene, quantity: str) -> Claim:
    """Whether PHIL-TD3 is ahead of the model that taught it."""
    text = f"{scene.title}: {BAR}, PHIL-TD3 is ahead of the human model in {WHAT[quantity]}"
    return _ahead(gathered, scene, quantity, [HUMAN], text)


def path_bar(
    gathered: Gathered, scene: Scene, line: Line, share: float, who: str, paper: str
) -> Claim:
    """Whether a mean surviving distance is at least a share of the full path."""
    means_m = list(path_by_seed(gathered, scene, line).values())
    found = mean_estimate(means_m)
    least_m = share * FULL_PATH_M[scene.scenario]
    each = f" ({' '.join(f'{mean_m:.2f}' for mean_m in means_m)})" if len(means_m) > 1 else ""
    return claim(
        f"{scene.title}: {BAR}, {who} survives {share:.0%} of the full path ({least_m:.2f} m)",
        paper,
        f"{found.text()} m{each}",
        "yes" if found.value >= least_m else "no",
        len(means_m),
        f"{BY_VALUE}, nothing beyond the goal counted",
        found,
        tested_all(gathered, scene, [line]),
    )


def _ahead(
    gathered: Gathered, scene: Scene, quantity: str, others: Sequence[Line], text: str
) -> Claim:
    """Whether PHIL-TD3's mean is above each other's: who is level with it is not behind it."""
    means = {line: _mean(gathered, scene, line, quantity) for line in (PHIL, *others)}
    order = sorted(means, key=lambda line: -means[line].value)
    unit, factor, digits = ("%", 100.0, 1) if quantity == SUCCESS else ("m", 1.0, 2)
    shown = [f"{line.label} {means[line].times(factor).text(digits)} {unit}" for line in order]
    notes = [BY_VALUE, "a tie is not ahead", "Student's interval over the seeds shown"]
    if quantity == DISTANCE:
        notes.append("nothing beyond the goal counted")
    return claim(
        text,
        "–",
        ", ".join(shown),
        "yes" if all(means[PHIL].value > means[line].value + ROUNDING for line in others) else "no",
        means[PHIL].size,
        "; ".join(notes),
        None,
        tested_all(gathered, scene, [PHIL, *others]),
    )


def _mean(gathered: Gathered, scene: Scene, line: Line, quantity: str) -> Estimate:
    by_seed = success_by_seed if quantity == SUCCESS else path_by_seed
    return mean_estimate(list(by_seed(gathered, scene, line).values()))
