"""What the environment is stepped with: the policy's command, or what a vehicle made of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np

from bridge.environments import brake_action, press_brake
from bridge.feedback_hold import VehicleDecision
from edge_runtime.latency.command_hold import Decision
from edge_runtime.wire import Feedback

Environment = gymnasium.Env[Any, Any]
Apply = Callable[[Environment, Decision], np.ndarray]
"""Returns the action of one tick, float32 [n], and presses or releases the brake."""
PEDAL = "pedal"


def policy_action(environment: Environment, decision: Decision) -> np.ndarray:
    """The command's action, the safe stop's, or (before the first command) hands off: zeros."""
    press_brake(environment, bool(decision.brake_reason))
    if decision.brake_reason:
        return brake_action(environment)
    if decision.command is None:
        return np.zeros(environment.action_space.shape or (1,), dtype=np.float32)
    return np.asarray(decision.command.action, dtype=np.float32)


def vehicle_action(action_names: Sequence[str]) -> Apply:
    """Return what applies what the vehicle's actuators have reached.

    Where the vehicle tells the speed of the scenario's car and the environment knows which pedal
    leads to it (``pedal_for_speed``), that pedal takes the place of the reported one: it makes up
    for what the last step missed, while errors of pedals would add up. Without feedback the car
    brakes fully; an environment that is only steered does so whenever the vehicle brakes.

    Args:
        action_names: of the policy's actions, in order.
    """

    def apply(environment: Environment, decision: Decision) -> np.ndarray:
        assert isinstance(decision, VehicleDecision)
        press_brake(environment, bool(decision.brake_reason))
        if decision.feedback is None:
            return brake_action(environment)
        action = np.clip(np.asarray(decision.feedback.action, dtype=np.float32), -1.0, 1.0)
        pedal = _pedal_for(environment, decision.feedback)
        if pedal is not None and PEDAL in action_names:
            action[list(action_names).index(PEDAL)] = pedal
        return action

    return apply


def _pedal_for(environment: Environment, feedback: Feedback) -> float | None:
    known = getattr(environment.unwrapped, "pedal_for_speed", None)
    if feedback.scenario_speed_mps is None or not callable(known):
        return None
    return float(known(feedback.scenario_speed_mps))
