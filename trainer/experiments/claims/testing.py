"""Claims about trained policies: figs. 9 and 10, and tables 1 and 2."""

from __future__ import annotations

from trainer.experiments.claims.compare import (
    BY_VALUE,
    BY_WILSON,
    scene_claim,
    seeds_of,
    spread,
    success,
    tested_all,
)
from trainer.experiments.claims.learning import HI, IA, PER, PHIL
from trainer.experiments.figures.curves import Line
from trainer.experiments.figures.spread import BOXES
from trainer.experiments.gathered import Gathered, Outcome, pooled
from trainer.experiments.plan import (
    FULL_PATH_M,
    HUMAN_MODEL,
    SCENES,
    Scene,
)
from trainer.experiments.statistics import Holds, all_of, mean_estimate
from trainer.experiments.verdict import Claim, claim

HUMAN = Line(HUMAN_MODEL)
SUCCESS_BARS = {"L": 1.0, "L-N": 0.98, "L-V": 0.96, "C": 0.98, "C-N": 0.96, "C-V": 0.92}
"""What this project asks of PHIL-TD3 in each scene."""
HUMAN_SHARE = 0.97
"""Of the full distance, asked of the human model."""
PATH_SHARE = 0.99
"""Of the full path, asked of PHIL-TD3 in the left turn."""
PAPER_TABLES: dict[str, dict[str, tuple[tuple[float, float], ...]]] = {
    "left_turn": {
        "phil_td3": ((21.28, 0.02), (21.27, 0.02), (21.29, 0.02)),
        "ia_td3": ((20.37, 2.58), (19.75, 3.05), (19.46, 3.03)),
        "hi_td3": ((20.87, 1.76), (20.63, 1.74), (19.90, 2.65)),
        HUMAN_MODEL: ((20.70, 1.82), (20.88, 1.32), (20.90, 1.21)),
    },
    "congestion": {
        "phil_td3": ((80.15, 0.08), (79.26, 4.30), (77.29, 11.55)),
        "ia_td3": ((79.26, 5.90), (78.64, 6.11), (78.39, 7.66)),
        "hi_td3": ((76.27, 16.00), (76.02, 13.72), (73.57, 18.49)),
        HUMAN_MODEL: ((80.11, 0.07), (77.66, 12.27), (75.15, 15.20)),
    },
}
"""Tables I and II: mean and standard deviation of the surviving distance, m, by scene."""


def judge_fig9(gathered: Gathered) -> list[Claim]:
    """Success and surviving distance in the six scenes."""
    others = [IA, HI, PER, HUMAN]
    claims = []
    for scene in SCENES:
        claims.append(_success_bar(gathered, scene))
        claims.append(_success_claim(gathered, scene, others))
        claims.append(
            scene_claim(
                gathered,
                scene,
                "distance_m",
                PHIL,
                others,
                "PHIL-TD3 survives furthest, the human model included",
                "furthest",
            )
        )
    return claims


def _success_bar(gathered: Gathered, scene: Scene) -> Claim:
    """Success of the seed that validated best: the policy one would deploy."""
    outcomes = gathered.tested(scene, PHIL.algorithm)
    bar = SUCCESS_BARS[scene.label]
    best = success(outcomes and [max(outcomes, key=_validated)], scene.condition)
    everything = success(outcomes, scene.condition)
    each = ", ".join(f"{success([one], scene.condition).value:.0%}" for one in outcomes)
    holds: Holds = "yes" if best.value >= bar else "no"
    return claim(
        f"{scene.title}: bar of this project, success of PHIL-TD3 at least {bar:.0%}",
        "highest of all",
        f"best validated seed {best.text()}; all seeds {everything.text()} ({each})",
        holds,
        len(outcomes),
        f"{BY_VALUE} of the best validated seed, {best.size} episodes",
        best,
        tested_all(gathered, scene, [PHIL]),
    )


def _validated(outcome: Outcome) -> tuple[float, int]:
    """Best on the validation seeds; of equals, the lower seed. Tests decide nothing here."""
    return (outcome.best_validation, -outcome.unit.seed)


def _success_claim(gathered: Gathered, scene: Scene, others: list[Line]) -> Claim:
    shares = {
        line: success(gathered.tested(scene, line.algorithm), scene.condition)
        for line in (PHIL, *others)
    }
    own = shares.pop(PHIL)
    answers: list[Holds] = []
    for other in shares.values():
        separate: Holds = "no" if own.high < other.low else "undecided"
        answers.append("yes" if own.low > other.high else separate)
    first = all(own.value >= other.value for other in shares.values() if other.size)
    shown = [f"{line.label} {each.text()}" for line, each in {PHIL: own, **shares}.items()]
    return claim(
        f"{scene.title}: PHIL-TD3 has the highest success rate, the human model included",
        "highest",
        f"{', '.join(shown)}; PHIL-TD3 {'first or equal' if first else 'not first'} by value",
        all_of(answers),
        seeds_of(gathered, scene, [PHIL, *others]),
        BY_WILSON,
        own,
        tested_all(gathered, scene, [PHIL, *others]),
    )


def judge_fig10(gathered: Gathered) -> list[Claim]:
    """Time in the left turn and smoothness in the congestion."""
    claims = []
    for scene in SCENES:
        quantity = BOXES[scene.scenario]
        place = (gathered, scene, quantity.column)
        if scene.scenario == "left_turn" or scene.condition == "variant":
            what = "takes the least time" if scene.scenario == "left_turn" else "is the smoothest"
            claims.append(
                scene_claim(*place, PHIL, [IA, HI, PER], f"PHIL-TD3 {what}", "least",
                            -1.0, quantity.arrived)
            )  # fmt: skip
        else:
            for line in (PHIL, IA, HI):
                text = f"{line.label}, guided by the human, is smoother than vanilla TD3"
                claims.append(scene_claim(*place, line, [PER], text, "smoother", -1.0))
    return claims


def judge_table(gathered: Gathered, scenario: str) -> list[Claim]:
    """The human model against those whom it taught, and the bars on distances."""
    paper = PAPER_TABLES[scenario]
    lines = [Line(name) for name in paper]
    claims = []
    for place, scene in enumerate(s for s in SCENES if s.scenario == scenario):
        numbers = [f"{line.label} {'{:.2f}±{:.2f}'.format(*paper[line.algorithm][place])}"
                   for line in lines]  # fmt: skip
        one = scene_claim(
            gathered, scene, "distance_m", PHIL, [HUMAN],
            "PHIL-TD3 survives further than the human model that taught it", ", ".join(numbers),
        )  # fmt: skip
        ours = [f"{line.label} {spread(gathered, scene, line, 'distance_m')}" for line in lines]
        claims.append(Claim(**{**vars(one), "ours": ", ".join(ours)}))
        if scenario == "left_turn":
            claims.append(_distance_bar(gathered, scene, PHIL, PATH_SHARE, "PHIL-TD3"))
    nominal = next(scene for scene in SCENES if scene.scenario == scenario)
    claims.append(_distance_bar(gathered, nominal, HUMAN, HUMAN_SHARE, "the human model"))
    return claims


def _distance_bar(gathered: Gathered, scene: Scene, line: Line, share: float, who: str) -> Claim:
    outcomes = gathered.tested(scene, line.algorithm)
    distances_m = pooled(outcomes, scene.condition, "distance_m")
    found = mean_estimate(distances_m)
    least_m = share * FULL_PATH_M[scene.scenario]
    mean_m = PAPER_TABLES[scene.scenario][line.algorithm][_place(scene)][0]
    return claim(
        f"{scene.title}: bar of this project, {who} survives {share:.0%} of the full path "
        f"({least_m:.2f} m)",
        f"{mean_m:.2f} m",
        f"{found.text()} m over {found.size} episodes",
        "yes" if found.value >= least_m else "no",
        len(outcomes),
        BY_VALUE,
        found,
        tested_all(gathered, scene, [line]),
    )


def _place(scene: Scene) -> int:
    return [s for s in SCENES if s.scenario == scene.scenario].index(scene)
