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
from trainer.experiments.statistics import judge_all
from trainer.experiments.verdict import Claim, claim

COMPETITIVE = 0.05
"""Who succeeds less often by less than this share is competitive; the paper gives no number."""


def competitive_claim(
    gathered: Gathered, scene: Scene, line: Line, others: Sequence[Line]
) -> Claim:
    """Whether one line's success is about that of each of the others, or above it."""
    lines = [line, *others]
    own = success_by_seed(gathered, scene, line)
    ahead = {
        other.label: difference(own, success_by_seed(gathered, scene, other)) for other in others
    }
    judged = judge_all(ahead, least=-COMPETITIVE)
    shown = [f"{one.label} {shown_of(gathered, scene, one, SUCCESS)}" for one in lines]
    points = [each.times(100.0).text(1) for each in ahead.values()]
    return claim(
        f"{scene.title}: {line.label} is competitive with "
        f"{' and '.join(other.label for other in others)} in success",
        "competitive",
        f"{', '.join(shown)}; percentage points ahead: {', '.join(points)}",
        judged.holds,
        judged.size,
        f"less than {100 * COMPETITIVE:.0f} percentage points behind each; {BY_SEED}",
        judged.decisive.times(100.0) if judged.decisive else None,
        tested_all(gathered, scene, lines),
        judged.rival,
    )


def degraded_claim(gathered: Gathered, scenario: str, lines: Sequence[Line]) -> Claim:
    """Whether each line succeeds less often in the variant scene than in the one it learned in."""
    nominal, variant = (
        next(s for s in SCENES if (s.scenario, s.condition) == (scenario, condition))
        for condition in ("nominal", "variant")
    )
    points = {}
    for line in lines:
        before, after = (success_by_seed(gathered, scene, line) for scene in (nominal, variant))
        points[line.label] = difference(before, after).times(100.0)
    judged = judge_all(points)
    shown = [f"{name} {lost.text(1)}" for name, lost in points.items()]
    return claim(
        f"{SCENARIO_TITLES[scenario]}: the variant scene degrades the baselines' success",
        "significantly",
        f"percentage points lost: {', '.join(shown)}",
        judged.holds,
        judged.size,
        BY_SEED,
        judged.decisive,
        all(tested_all(gathered, scene, lines) for scene in (nominal, variant)),
        judged.rival,
    )
