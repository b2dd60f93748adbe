"""Claims about trained policies: figs. 9 and 10, and tables 1 and 2."""

from __future__ import annotations

from dataclasses import replace

from trainer.experiments.claims.baselines import competitive_claim, degraded_claim
from trainer.experiments.claims.compare import BY_VALUE
from trainer.experiments.claims.lines import HI, HUMAN, IA, PER, PHIL
from trainer.experiments.claims.scenes import (
    DISTANCE,
    SUCCESS,
    path_by_seed,
    scene_claim,
    shown_of,
    spread_claim,
    success,
    tested_all,
)
from trainer.experiments.figures.curves import Line
from trainer.experiments.figures.spread import BOXES
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import (
    FULL_PATH_M,
    HUMAN_MODEL,
    SCENARIO_TITLES,
    SCENES,
    Scene,
)
from trainer.experiments.statistics import mean_estimate
from trainer.experiments.verdict import Claim, claim

SUCCESS_BARS = {"L": 1.0, "L-N": 0.98, "L-V": 0.96, "C": 0.98, "C-N": 0.96, "C-V": 0.92}
"""What this project asks of PHIL-TD3 in each scene."""
FURTHEST = {"C-V": "furthest; but in table II IA-TD3 78.39 m, PHIL-TD3 77.29 m"}
"""Where the paper's text and its tables disagree about who survives furthest."""
STEADIEST = {"C-V": "lowest variance; but in table II IA-TD3 ±7.66 m, PHIL-TD3 ±11.55 m"}
"""And about whose distances differ least."""
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
    others = [IA, HI, PER]
    claims = []
    for scene in SCENES:
        place = (gathered, scene)
        claims += [
            _success_bar(*place),
            _human_bar(*place),
            scene_claim(*place, SUCCESS, PHIL, others, "PHIL-TD3 has the highest success rate",
                        "highest"),
            scene_claim(*place, DISTANCE, PHIL, others, "PHIL-TD3 survives furthest",
                        FURTHEST.get(scene.label, "furthest")),
            spread_claim(*place, PHIL, others, "PHIL-TD3's surviving distance differs least from "
                         "drive to drive", STEADIEST.get(scene.label, "lowest variance")),
            competitive_claim(*place, PER, [IA, HI]),
        ]  # fmt: skip
    claims += [degraded_claim(gathered, scenario, others) for scenario in SCENARIO_TITLES]
    return claims


def _success_bar(gathered: Gathered, scene: Scene) -> Claim:
    """Mean success of all seeds, each of which is shown."""
    outcomes = gathered.tested(scene, PHIL.algorithm)
    bar = SUCCESS_BARS[scene.label]
    everything = success(outcomes, scene.condition)
    return claim(
        f"{scene.title}: bar of this project, success of PHIL-TD3 at least {bar:.0%}",
        "highest of all",
        f"{shown_of(gathered, scene, PHIL, SUCCESS)}, all drives {everything.text()}",
        "yes" if everything.value >= bar else "no",
        len(outcomes),
        f"{BY_VALUE}; Wilson's interval shown",
        everything,
        tested_all(gathered, scene, [PHIL]),
    )


def _human_bar(gathered: Gathered, scene: Scene) -> Claim:
    """Whether the mean success of all seeds is above the human model's."""
    own, human = (
        success(gathered.tested(scene, line.algorithm), scene.condition) for line in (PHIL, HUMAN)
    )
    shown = [f"{line.label} {shown_of(gathered, scene, line, SUCCESS)}" for line in (PHIL, HUMAN)]
    return claim(
        f"{scene.title}: bar of this project, PHIL-TD3 succeeds more often than the human model",
        "–",
        ", ".join(shown),
        "yes" if own.value > human.value else "no",
        len(gathered.tested(scene, PHIL.algorithm)),
        BY_VALUE,
        None,
        tested_all(gathered, scene, [PHIL, HUMAN]),
    )


def judge_fig10(gathered: Gathered) -> list[Claim]:
    """Time in the left turn and smoothness in the congestion, of drives that arrive.

    The paper's boxes of smoothness have the others, too; but who crashes at once was smooth.
    """
    claims = []
    for scene in SCENES:
        quantity = BOXES[scene.scenario]
        place = (gathered, scene, quantity.column)
        if scene.scenario == "left_turn" or scene.condition == "variant":
            what, paper = (
                ("takes the least time", "least")
                if scene.scenario == "left_turn"
                else ("is the smoothest", "an advantage")
            )
            claims.append(
                scene_claim(*place, PHIL, [IA, HI, PER], f"PHIL-TD3 {what}", paper,
                            -1.0, arrived=True)
            )  # fmt: skip
        else:
            for line in (PHIL, IA, HI):
                text = f"{line.label}, guided by the human, is smoother than vanilla TD3"
                claims.append(
                    scene_claim(*place, line, [PER], text, "smoother", -1.0, arrived=True)
                )
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
            gathered, scene, DISTANCE, PHIL, [HUMAN],
            "PHIL-TD3 survives further than the human model that taught it", ", ".join(numbers),
        )  # fmt: skip
        ours = [f"{line.label} {shown_of(gathered, scene, line, DISTANCE)}" for line in lines]
        claims.append(replace(one, ours=", ".join(ours)))
        if scenario == "left_turn":
            claims.append(_distance_bar(gathered, scene, PHIL, PATH_SHARE, "PHIL-TD3"))
    nominal = next(scene for scene in SCENES if scene.scenario == scenario)
    claims.append(_distance_bar(gathered, nominal, HUMAN, HUMAN_SHARE, "the human model"))
    return claims


def _distance_bar(gathered: Gathered, scene: Scene, line: Line, share: float, who: str) -> Claim:
    means_m = list(path_by_seed(gathered, scene, line).values())
    found = mean_estimate(means_m)
    least_m = share * FULL_PATH_M[scene.scenario]
    mean_m = PAPER_TABLES[scene.scenario][line.algorithm][_place(scene)][0]
    each = f" ({' '.join(f'{mean_m:.2f}' for mean_m in means_m)})" if len(means_m) > 1 else ""
    return claim(
        f"{scene.title}: bar of this project, {who} survives {share:.0%} of the full path "
        f"({least_m:.2f} m)",
        f"{mean_m:.2f} m",
        f"{found.text()} m{each}",
        "yes" if found.value >= least_m else "no",
        len(means_m),
        f"{BY_VALUE}, nothing beyond the goal counted",
        found,
        tested_all(gathered, scene, [line]),
    )


def _place(scene: Scene) -> int:
    return [s for s in SCENES if s.scenario == scene.scenario].index(scene)
