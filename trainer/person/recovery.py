"""What a killed training run had recorded, but not yet saved: back into its replay buffer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from trainer.human.guide import Action, Intervention
from trainer.person.recording import Step, read_episodes, read_steps, sittings
from trainer.training.delayed import Store

Position = tuple[int, int]
"""Sitting and index of a recorded step."""
Shape = Callable[[float, Intervention | None], float]
"""The reward to store (eq. 17), from the environment's and what the person did."""
Penalises = Callable[[Intervention | None], bool]
"""Whether what the person did costs the policy the penalty."""


def steps_since(directory: Path, position: Position) -> Iterator[Step]:
    """The recorded steps from ``position`` on, over all sittings."""
    for path in sittings(directory):
        yield from (step for step in read_steps(path) if (step.sitting, step.index) >= position)


def store_again(
    store: Store,
    steps: Iterable[Step],
    shape: Shape,
    penalises: Penalises,
    ticks_late: int = 0,
) -> tuple[int, int]:
    """Put recorded steps into the replay buffer as the run had put them there.

    Episodes that the person discarded are left out.

    Args:
        store: the learner, or its buffer.
        steps: in their order.
        shape: the run's reward shaping.
        penalises: whether the run charges an intervention to the overruled action.
        ticks_late: how many ticks old the observation is that an action answers, behind a network
            (``training/wheel.py``).

    Returns:
        How many steps were stored, and how many of them are the person's.
    """
    stored = human = 0
    for episode in read_episodes(steps):
        for known, step in zip(episode, episode[ticks_late:], strict=False):
            if step is episode[ticks_late]:
                store.start_episode(known.observation)
            action = np.array([step.action], np.float32)
            by_person = Intervention(action, "person", step.first) if step.human else None
            store.add(
                action,
                shape(step.reward, by_person),
                known.next_observation,
                step.terminated,
                step.human,
                overruled=_array(step.policy_action, action),
                penalised=penalises(by_person),
            )
            stored += 1
            human += step.human
    return stored, human


def _array(value: float | None, otherwise: Action) -> Action:
    return otherwise if value is None else np.array([value], np.float32)
