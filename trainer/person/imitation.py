"""What a person did, as demonstrations for the human model (section V)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from edge_runtime.util import UserError
from trainer.human.model import HumanModel
from trainer.person.recording import Step, read_episodes, read_steps


def demonstrate(
    model: HumanModel, recordings: Sequence[Path], scenario: str, left_out: Sequence[str] = ()
) -> int:
    """Give the model every recorded step in which the person was in control.

    Of a hand-over, the model gets what the hands said, not the blend that was applied; on the way
    back to the policy the hands have let go, and say nothing. Episodes that the person discarded
    are left out.

    Args:
        model: learns from it.
        recordings: the files.
        scenario: that was driven.
        left_out: sittings, and episodes of them, that do not count: ``3``, or ``3:7`` for
            episode 7 of sitting 3.

    Returns:
        How many take-overs the recordings hold; a whole episode driven alone is one.

    Raises:
        UserError: a recording of another scenario, none in which a person drove, or something left
            out that is not there.
    """
    interventions, unknown = 0, set(left_out)
    for path in recordings:
        for episode in read_episodes(_of_scenario(path, scenario)):
            names = {f"{episode[0].sitting}", f"{episode[0].sitting}:{episode[0].episode}"}
            unknown -= names
            if names.isdisjoint(left_out):
                interventions += _learn(model, episode)
    if unknown:
        raise UserError(f"--leave-out {min(unknown)}: there is no such episode in these recordings")
    if not model.demonstrations:
        raise UserError("nobody took over in these recordings: there is nothing to imitate")
    return interventions


def _learn(model: HumanModel, episode: Sequence[Step]) -> int:
    """Add what the person did in an episode; how often they took over."""
    for step in episode:
        if step.control == "human":
            model.add(step.observation, np.array([step.human_action], np.float32))
    return sum(step.first for step in episode)


def _of_scenario(path: Path, scenario: str) -> Iterator[Step]:
    for step in read_steps(path):
        if step.scenario != scenario:
            raise UserError(f"{path} was driven in {step.scenario}, not in {scenario}")
        yield step
