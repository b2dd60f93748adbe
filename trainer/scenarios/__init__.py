"""The driving scenarios; importing this registers them with gymnasium."""

from gymnasium.envs.registration import register, registry

SCENARIOS = {"left_turn": "phil/LeftTurn-v0"}
"""Scenario name on the command line -> gymnasium id."""

if "phil/LeftTurn-v0" not in registry:
    # No gymnasium wrappers by default: the scenario counts its own steps and reports `timeout`.
    register(
        id="phil/LeftTurn-v0",
        entry_point="trainer.scenarios.left_turn:LeftTurnEnv",
        disable_env_checker=True,
        order_enforce=False,
    )
