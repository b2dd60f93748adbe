"""The algorithms that claims are about."""

from __future__ import annotations

from trainer.experiments.figures.curves import Line
from trainer.experiments.plan import HUMAN_MODEL

PHIL, IA, HI, PER = map(Line, ("phil_td3", "ia_td3", "hi_td3", "per_td3"))
TDQA = Line("phil_td3", name="PHIL-TD3 (TDQA, w = 1)")
"""PHIL-TD3 beside other priorities and other weights."""
HUMAN = Line(HUMAN_MODEL)
TD, Q_ADVANTAGE = Line("phil_td_only"), Line("phil_q_advantage_only")
SMALL, LARGE = Line("phil_advantage_0.1"), Line("phil_advantage_100")
RD2, RD2_PHIL = Line("rd2_td3"), Line("rd2_phil")
NO_CLONING, NO_SHAPING = map(Line, ("phil_without_cloning", "phil_without_shaping"))
NO_TDQA = IA
"""IA-TD3 is PHIL-TD3 without TDQA: the same switches."""
