"""A person in the place of the scripted human: the same ``watch``, paced by the person's clock."""

from __future__ import annotations

import numpy as np

from trainer.human.guide import Action, Intervention, Observation
from trainer.person.sitting import Sitting


class PersonGuide:
    """Asks the person each control period, and waits for it to begin.

    Args:
        sitting: whoever sits there.
    """

    def __init__(self, sitting: Sitting) -> None:
        self._sitting = sitting

    def reset(self) -> None:
        """The sitting begins an episode by itself when the environment is reset."""

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What the person does about ``policy_action``: None lets it pass. Once a step.

        The action is the one that is carried out: in a hand-over neither the person's nor the
        policy's, and the person's in the replay buffer.
        """
        applied = self._sitting.decide(observation, float(policy_action[0]))
        if not applied.human:
            return None
        action = np.array([applied.action], np.float32)
        return Intervention(action, "person", applied.first)
