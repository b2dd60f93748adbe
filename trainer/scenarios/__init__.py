"""The driving scenarios; importing this registers them with gymnasium."""

from typing import Literal

from gymnasium.envs.registration import register

Scene = Literal["nominal", "variant", "dense"]
"""The trained scene; one with more and other vehicles (section VII-D); one with denser traffic."""
SCENARIOS = {"left_turn": "phil/LeftTurn-v0", "congestion": "phil/Congestion-v0"}
"""Scenario name on the command line -> gymnasium id."""
LEFT_TURN, CONGESTION = SCENARIOS.values()
"""For the entry points of the group ``phil.scenarios``."""

for _id, _class in (
    (LEFT_TURN, "trainer.scenarios.left_turn:LeftTurnEnv"),
    (CONGESTION, "trainer.scenarios.congestion:CongestionEnv"),
):
    # No gymnasium wrappers by default: a scenario counts its own steps and reports `timeout`.
    register(id=_id, entry_point=_class, disable_env_checker=True, order_enforce=False)
