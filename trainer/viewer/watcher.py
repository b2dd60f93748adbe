"""The loop's side of the view: gathers, hands over, and never waits.

Everything that takes time, rerun's calls and the critic's, is done in a thread of its own
(``background.py``); here is what must be taken while it is there.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from typing import Any

from bridge.rerun.draw import PICTURE_INTERVAL_S, Pace
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import Seen, TrainingRun
from trainer.viewer.entries import Correction, Entry, Episode, Picture, StepEntry, Steps

STEPS_TOGETHER = 50
"""Numbers are handed over with a picture, or when there are so many."""
CORRECTIONS = 32
"""Of an episode whose Q advantage is shown: evenly spread, as the critic's time is not for free."""


class Watcher:
    """Looks on at one run.

    Args:
        run: the run; its environment is asked for the scene.
        put: takes what is to be drawn; must not block.
    """

    def __init__(self, run: TrainingRun, put: Callable[[Entry], None]) -> None:
        self._run, self._put = run, put
        self._pace = Pace(PICTURE_INTERVAL_S)
        self._step = run.learning.added
        self._entries: list[StepEntry] = []
        self._corrections: list[Correction] = []

    def on_step(self, seen: Seen) -> None:
        """Take a control period."""
        intervention = seen.intervention
        self._entries.append(
            StepEntry(
                self._step,
                float(seen.policy_action[0]),
                float(seen.action[0]),
                seen.speed_mps,
                None if intervention is None else intervention.reason,
            )
        )
        if intervention is not None:
            self._corrections.append(
                Correction(self._step, seen.observation, seen.policy_action, seen.action)
            )
        if self._pace.due(time.monotonic()):
            scene: dict[str, Any] = self._run.env.scene()
            self._hand_over(Picture(self._step, seen.observation, scene))
        elif len(self._entries) >= STEPS_TOGETHER:
            self._hand_over(None)
        self._step += 1

    def close(self) -> None:
        """Hand over what an episode that was broken off has left."""
        self._hand_over(None)

    def on_episode(self, metrics: EpisodeMetrics) -> None:
        """Take an episode's end; no update is under way."""
        self._hand_over(None)
        chosen = _spread(self._corrections, CORRECTIONS)
        critic = None
        if chosen:
            critic = copy.deepcopy(self._run.learning.learner.target_critics.first).cpu()
        self._corrections = []
        self._put(Episode(max(self._step - 1, 0), metrics, chosen, critic))

    def _hand_over(self, picture: Picture | None) -> None:
        entries, self._entries = self._entries, []
        if entries:
            self._put(Steps(entries, picture))


def _spread(corrections: list[Correction], most: int) -> list[Correction]:
    """At most so many, evenly spread, the first among them."""
    stride = -(-len(corrections) // most) or 1
    return corrections[::stride]
