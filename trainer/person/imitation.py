"""What a person did, as demonstrations for the human model (section V)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edge_runtime.errors import UserError
from trainer.human.model import HumanModel
from trainer.person.recording import read_steps


def demonstrate(model: HumanModel, recordings: Sequence[Path], scenario: str) -> int:
    """Give the model every recorded step in which the person was in control.

    Of a hand-over, the model gets what the hands said, not the blend that was applied; on the way
    back to the policy the hands have let go, and say nothing.

    Returns:
        How many take-overs the recordings hold; a whole episode driven alone is one.

    Raises:
        UserError: a recording of another scenario, or none in which a person drove.
    """
    interventions = 0
    for path in recordings:
        for step in read_steps(path):
            if step.scenario != scenario:
                raise UserError(f"{path} was driven in {step.scenario}, not in {scenario}")
            interventions += step.first
            if step.control == "human":
                model.add(step.observation, np.array([step.human_action], np.float32))
    if not model.demonstrations:
        raise UserError("nobody took over in these recordings: there is nothing to imitate")
    return interventions
