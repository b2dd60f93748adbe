"""Claims about trained policies: figs. 9 and 10, and tables 1 and 2."""

from __future__ import annotations

from dataclasses import replace

from trainer.experiments.claims.bars import first_bar, human_bar, path_bar, success_bar
from trainer.experiments.claims.baselines import competitive_claim, degraded_claim
from trainer.experiments.claims.lines import HI, HUMAN, IA, PER, PHIL
from trainer.experiments.claims.scenes import (
    DISTANCE,
    SUCCESS,
    scene_claim,
    shown_of,
    spread_claim,
)
from trainer.experiments.figures.curves import Line
from trainer.experiments.figures.spread import BOXES
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import HUMAN_MODEL, SCENARIO_TITLES, SCENES, Scene
from trainer.experiments.verdict import Claim

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
            success_bar(*place),
            *(first_bar(*place, quantity, others) for quantity in (SUCCESS, DISTANCE)),
            *(human_bar(*place, quantity) for quantity in (SUCCESS, DISTANCE)),
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
            claims.append(_path_bar(gathered, scene, PHIL, PATH_SHARE, "PHIL-TD3"))
    nominal = next(scene for scene in SCENES if scene.scenario == scenario)
    claims.append(_path_bar(gathered, nominal, HUMAN, HUMAN_SHARE, "the human model"))
    return claims


def _path_bar(gathered: Gathered, scene: Scene, line: Line, share: float, who: str) -> Claim:
    mean_m = PAPER_TABLES[scene.scenario][line.algorithm][_place(scene)][0]
    return path_bar(gathered, scene, line, share, who, f"{mean_m:.2f} m")


def _place(scene: Scene) -> int:
    return [s for s in SCENES if s.scenario == scene.scenario].index(scene)
