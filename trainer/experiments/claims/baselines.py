"""What the paper says of the baselines' tests: fig. 9."""

from __future__ import annotations

from collections.abc import Sequence

from trainer.experiments.claims.compare import BY_SEED, difference
from trainer.experiments.claims.scenes import (
    SUCCESS,
    shown_of,
    success_by_seed,
    tested_all,
)
from trainer.experiments.figures.curves import Line
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import SCENARIO_TITLES, SCENES, Scene
from trainer.experiments.statistics import above, all_of, decisive, within
from trainer.experiments.verdict import Claim, claim

COMPETITIVE = 0.05
"""Shares of success that differ by no more are competitive; the paper gives no number."""


def competitive_claim(
    gathered: Gathered, scene: Scene, line: Line, others: Sequence[Line]
) -> Claim:
    """Whether one line's success is much the same as each of the others'."""
    lines = [line, *others]
    own = success_by_seed(gathered, scene, line)
    differences = [difference(own, success_by_seed(gathered, scene, other)) for other in others]
    shown = [f"{one.label} {shown_of(gathered, scene, one, SUCCESS)}" for one in lines]
    return claim(
        f"{scene.title}: {line.label} is competitive with "
        f"{' and '.join(other.label for other in others)} in success",
        "competitive",
        ", ".join(shown),
        all_of([within(each, COMPETITIVE) for each in differences]),
        min(each.size for each in differences),
        f"within {100 * COMPETITIVE:.0f} percentage points of each; {BY_SEED}",
        None,
        tested_all(gathered, scene, lines),
    )


def degraded_claim(gathered: Gathered, scenario: str, lines: Sequence[Line]) -> Claim:
    """Whether each line succeeds less often in the variant scene than in the one it learned in."""
    nominal, variant = (
        next(s for s in SCENES if (s.scenario, s.condition) == (scenario, condition))
        for condition in ("nominal", "variant")
    )
    shares = [[success_by_seed(gathered, s, line) for s in (nominal, variant)] for line in lines]
    losses = [difference(before, after) for before, after in shares]
    shown = [
        f"{line.label} {loss.times(100.0).text(1)}"
        for line, loss in zip(lines, losses, strict=True)
    ]
    return claim(
        f"{SCENARIO_TITLES[scenario]}: the variant scene degrades the baselines' success",
        "significantly",
        f"percentage points lost: {', '.join(shown)}",
        all_of([above(loss) for loss in losses]),
        min(loss.size for loss in losses),
        BY_SEED,
        decisive(losses),
        all(tested_all(gathered, scene, lines) for scene in (nominal, variant)),
    )
