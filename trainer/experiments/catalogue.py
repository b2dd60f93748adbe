"""Every experiment of the paper: what it trains, how it is drawn, what it claims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import product

from matplotlib.figure import Figure

from trainer.experiments.claims import difficulty, guidance, learning, ours, testing
from trainer.experiments.claims.lines import TDQA
from trainer.experiments.figures.bars import draw_difficulty, draw_guidance, draw_tests
from trainer.experiments.figures.curves import Line, draw_curves
from trainer.experiments.figures.spread import draw_boxes, draw_distributions, draw_table
from trainer.experiments.gathered import Gathered
from trainer.experiments.plan import (
    EXACT_LOSSES,
    HUMAN_MODEL,
    IMPORTANCE,
    LAST_ACTOR,
    NETWORK,
    NORMAL,
    POOR,
    PRINTED_RATES,
    PRINTED_REWARD,
    REMEDY,
    SCENARIO_TITLES,
    TOUGH,
    WEAK_CLONING,
)
from trainer.experiments.units import Unit
from trainer.experiments.verdict import Claim

PAPERS = ("phil_td3", "ia_td3", "hi_td3", "per_td3")
"""The algorithms that the paper compares throughout."""
GUIDED = PAPERS[:3]
BOTH = tuple(SCENARIO_TITLES)
HUMAN_SEED = 0
"""There is one human model a scenario; its unit has this number."""


@dataclass(frozen=True)
class Experiment:
    """A figure or a table."""

    title: str
    lines: tuple[Line, ...]
    """Algorithms and settings to be trained, each in all scenarios with all seeds."""
    draw: Callable[[Gathered], Figure]
    judge: Callable[[Gathered], list[Claim]]
    scenarios: tuple[str, ...] = BOTH
    human: bool = False
    """Whether the human model is tested, too."""

    def units(self, seeds: int) -> list[Unit]:
        """What it needs, with the seeds 1, 2, ..."""
        human = [Unit(scenario, HUMAN_MODEL, NORMAL, HUMAN_SEED) for scenario in self.scenarios]
        trained = [
            Unit(scenario, line.algorithm, line.setting, seed)
            for line, scenario, seed in product(self.lines, self.scenarios, range(1, seeds + 1))
        ]
        return [*(human if self.human else []), *trained]


def _lines(algorithms: Iterable[str], *settings: str) -> tuple[Line, ...]:
    return tuple(Line(name, setting) for setting in settings or (NORMAL,) for name in algorithms)


def _curves(
    title: str,
    lines: tuple[Line, ...],
    judge: Callable[[Gathered], list[Claim]],
    by_metric: bool = True,
) -> Experiment:
    draw = partial(draw_curves, lines=lines, by_metric=by_metric)
    return Experiment(title, lines, draw, judge)


def _table(title: str, scenario: str) -> Experiment:
    return Experiment(
        title,
        _lines(GUIDED),
        partial(draw_table, scenario=scenario, paper=testing.PAPER_TABLES[scenario]),
        partial(testing.judge_table, scenario=scenario),
        (scenario,),
        human=True,
    )


EXPERIMENTS: dict[str, Experiment] = {
    "fig7": _curves("learning curves", _lines(PAPERS), learning.judge_fig7, by_metric=False),
    "fig8": Experiment(
        "learning in the normal and the tough setting",
        _lines(PAPERS, NORMAL, TOUGH),
        partial(draw_difficulty, algorithms=PAPERS),
        difficulty.judge_fig8,
    ),
    "fig9": Experiment(
        "success and surviving distance in six scenes",
        _lines(PAPERS),
        partial(draw_tests, algorithms=PAPERS),
        testing.judge_fig9,
        human=True,
    ),
    "fig10": Experiment(
        "time and smoothness in six scenes",
        _lines(PAPERS),
        partial(draw_boxes, algorithms=PAPERS),
        testing.judge_fig10,
    ),
    "fig11": _curves(
        "priority schemes",
        (TDQA, *_lines(("phil_td_only", "phil_q_advantage_only"))),
        learning.judge_fig11,
    ),
    "fig12": _curves(
        "weights of the Q-advantage",
        (TDQA, *_lines(("phil_advantage_0.1", "phil_advantage_100"))),
        learning.judge_fig12,
    ),
    "fig13": _curves(
        "one replay buffer or two",
        _lines(("phil_td3", "rd2_phil", "rd2_td3")),
        learning.judge_fig13,
    ),
    "fig14": Experiment(
        "surviving distance under good and poor guidance",
        _lines(GUIDED, NORMAL, POOR),
        partial(draw_guidance, algorithms=GUIDED),
        guidance.judge_fig14,
    ),
    "fig15": Experiment(
        "accelerations under good and poor guidance",
        _lines(GUIDED, NORMAL, POOR),
        partial(draw_distributions, algorithms=GUIDED),
        guidance.judge_fig15,
    ),
    "table1": _table("surviving distance beside the human model, left turn", "left_turn"),
    "table2": _table("surviving distance beside the human model, congestion", "congestion"),
    "ablation": _curves(
        "PHIL-TD3 without each of its parts",
        (
            *_lines(("phil_td3", "phil_without_cloning")),
            Line("ia_td3", name="without TDQA (IA-TD3)"),
            Line("phil_without_shaping"),
        ),
        learning.judge_ablation,
        by_metric=False,
    ),
    "remedy": _curves(
        "baselines with a remedy for saturation (not in the paper)",
        (
            Line("phil_td3"),
            *_lines(("hi_td3", "per_td3")),
            *_lines(("hi_td3", "per_td3"), REMEDY),
        ),
        ours.judge_remedy,
        by_metric=False,
    ),
    "switches": _curves(
        "what the paper leaves open: losses, weights, learning rates, reward scale, actor judged",
        _lines(
            ("phil_td3",),
            *(NORMAL, EXACT_LOSSES, IMPORTANCE, WEAK_CLONING),
            *(PRINTED_RATES, PRINTED_REWARD, LAST_ACTOR),
        ),
        ours.judge_switches,
        by_metric=False,
    ),
    "network": _curves(
        "PHIL-TD3 trained with a network between policy and car",
        _lines(("phil_td3",), NORMAL, NETWORK),
        ours.judge_network,
        by_metric=False,
    ),
}
"""Name on the command line -> experiment; ``time`` is measured and has no units."""
OURS = ("remedy", "switches", "network")
"""Experiments that the paper does not have: computed last."""
TIME = "time"
NAMES = (*(name for name in EXPERIMENTS if name not in OURS), TIME, *OURS)


def units_of(names: Iterable[str], seeds: int, scenario: str | None = None) -> list[Unit]:
    """The units of some experiments, each once, those first that most experiments need.

    With ``scenario`` those of this one only.

    Of units that equally many need, all seeds of one algorithm come before the next algorithm.
    """
    papers = [experiment for name, experiment in EXPERIMENTS.items() if name not in OURS]
    needed = Counter(unit for experiment in papers for unit in experiment.units(seeds))
    wanted = [u for name in names if name != TIME for u in EXPERIMENTS[name].units(seeds)]
    unique = [unit for unit in dict.fromkeys(wanted) if scenario in (None, unit.scenario)]
    # The human model takes seconds, and its absence should be known before hours of training.
    return sorted(unique, key=lambda unit: (unit.trained, -needed[unit]))
