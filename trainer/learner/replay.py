"""The prioritised human-demonstration replay buffer (section IV-C, table A6).

One buffer for what the policy and what the human did (eq. 10, 19). Each picture is stored once:
a transition points at three of them, so 100,000 transitions take 380 MB instead of 1.4 GB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainer.learner.ledger import Ledger
from trainer.learner.sum_tree import Indices, SumTree

FRAME_SHAPE = (45, 80)


@dataclass(frozen=True)
class Batch:
    """A minibatch of ``n`` transitions."""

    indices: Indices
    frames: NDArray[np.uint8]
    """s, [n, 2, 45, 80]."""
    actions: NDArray[np.float32]
    """a, the action that was carried out, [n, action size]."""
    rewards: NDArray[np.float32]
    """r after shaping, [n]."""
    next_frames: NDArray[np.uint8]
    """s', [n, 2, 45, 80]."""
    terminals: NDArray[np.float32]
    """1 where s' ends the episode for good; a timeout is not terminal, [n]."""
    human: NDArray[np.bool_]
    """Delta: whether the human acted, [n]."""
    probabilities: NDArray[np.float64]
    """p(i), the probability with which each was drawn (eq. 20), [n]."""


class ReplayBuffer:
    """A ring of transitions, drawn in proportion to priority ** alpha.

    Args:
        capacity: transitions kept (table A6: 1e5).
        action_size: length of an action.
        alpha: priority scaling factor (eq. 20).
        separate: draw from the human's transitions and from the policy's apart, from each as
            often as its share of all (section VII-A: RD2).
    """

    def __init__(
        self, capacity: int, action_size: int = 1, alpha: float = 0.6, separate: bool = False
    ) -> None:
        self.capacity = capacity
        self.alpha = alpha
        self._ledger = Ledger(capacity)
        self._pictures = np.empty((self._ledger.frame_slots, *FRAME_SHAPE), np.uint8)
        self._actions = np.zeros((capacity, action_size), np.float32)
        self._rewards = np.zeros(capacity, np.float32)
        self._terminals = np.zeros(capacity, np.float32)
        self._human = np.zeros(capacity, np.bool_)
        self._priorities = np.zeros(capacity)
        self._trees = [SumTree(capacity) for _ in range(2 if separate else 1)]

    def __len__(self) -> int:
        return len(self._ledger)

    @property
    def added(self) -> int:
        """Transitions stored since the run began."""
        return self._ledger.added

    @property
    def human_count(self) -> int:
        """How many of the kept transitions are the human's."""
        return int(self._human[self._ledger.alive].sum())

    def mean_priorities(self) -> tuple[float, float]:
        """Mean priority of the policy's and of the human's transitions (nan where none)."""
        alive = self._ledger.alive
        human, priorities = self._human[alive], self._priorities[alive]
        return _mean(priorities[~human]), _mean(priorities[human])

    def start_episode(self, frames: NDArray[np.uint8]) -> None:
        """Take the first observation [2, 45, 80] of an episode."""
        self._ledger.start_episode(frames, self._add_picture)

    def add(
        self,
        action: NDArray[np.float32],
        reward: float,
        next_frames: NDArray[np.uint8],
        terminal: bool,
        human: bool,
    ) -> None:
        """Store a transition with the highest priority that any other has (algorithm 1)."""
        self._ledger.check_started()
        priority = self._highest_priority()
        slot = self._ledger.add_transition(self._add_picture(next_frames[1]))
        self._actions[slot] = action
        self._rewards[slot] = reward
        self._terminals[slot] = terminal
        self._human[slot] = human
        self.update_priorities(np.array([slot]), np.array([priority]))

    def sample(self, count: int, random: np.random.Generator) -> Batch:
        """Draw a minibatch by priority."""
        if len(self._trees) == 1:
            return self._gather(self._trees[0].sample(count, random))
        # Stratified over both: each kind gets its share of the samples, to one.
        strata = (np.arange(count) + random.random(count)) / count
        policys_share = 1.0 - self.human_count / len(self)
        policys = strata[strata < policys_share] / policys_share
        humans = (strata[strata >= policys_share] - policys_share) / (1.0 - policys_share)
        return self._gather(
            np.concatenate(
                [
                    tree.find(share * tree.total)
                    for tree, share in zip(self._trees, (policys, humans), strict=True)
                    if len(share)
                ]
            )
        )

    def update_priorities(self, indices: Indices, priorities: NDArray[np.float64]) -> None:
        """Set the priorities p of drawn transitions (eq. 21)."""
        if not np.all(np.isfinite(priorities)) or np.any(priorities < 0):
            raise ValueError("a priority must be finite and not negative")
        self._priorities[indices] = priorities
        self._set_weights(indices, priorities**self.alpha)

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, without the unused part of the arrays."""
        used, pictures = self._ledger.used, self._ledger.used_frames
        return {
            **self._ledger.state_dict(),
            "pictures": self._pictures[:pictures],
            "actions": self._actions[:used],
            "rewards": self._rewards[:used],
            "terminals": self._terminals[:used],
            "human": self._human[:used],
            "priorities": self._priorities[:used],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave; the next episode begins with ``start_episode``."""
        self._ledger.load_state_dict(state)
        used, pictures = self._ledger.used, self._ledger.used_frames
        self._pictures[:pictures] = state["pictures"]
        for name in ("actions", "rewards", "terminals", "human", "priorities"):
            getattr(self, f"_{name}")[:used] = state[name]
        # What was here before must not be drawn any more.
        self._trees = [SumTree(self.capacity) for _ in self._trees]
        alive = self._ledger.alive
        if len(alive):
            self._set_weights(alive, self._priorities[alive] ** self.alpha)

    def _gather(self, indices: Indices) -> Batch:
        slots = self._ledger.frame_ids[indices] % self._ledger.frame_slots
        pictures = self._pictures[slots]
        return Batch(
            indices=indices,
            frames=pictures[:, :2],
            actions=self._actions[indices],
            rewards=self._rewards[indices],
            next_frames=pictures[:, 1:],
            terminals=self._terminals[indices],
            human=self._human[indices],
            probabilities=self._probabilities(indices),
        )

    def _probabilities(self, indices: Indices) -> NDArray[np.float64]:
        if len(self._trees) == 1:
            return self._trees[0][indices] / self._trees[0].total
        human, share = self._human[indices], self.human_count / len(self)
        policys, humans = (tree[indices] / max(tree.total, 1e-300) for tree in self._trees)
        return np.where(human, share * humans, (1.0 - share) * policys)

    def _set_weights(self, indices: Indices, weights: NDArray[np.float64]) -> None:
        if len(self._trees) == 1:
            self._trees[0][indices] = weights
            return
        human = self._human[indices]
        for tree, own in zip(self._trees, (~human, human), strict=True):
            tree[indices] = weights * own

    def _highest_priority(self) -> float:
        if len(self) == 0:
            return 1.0
        return float(self._priorities[: self._ledger.used].max())

    def _add_picture(self, picture: NDArray[np.uint8]) -> int:
        """Store a picture and return its running number; forget transitions that lose theirs."""
        number, lost = self._ledger.add_picture()
        self._pictures[number % self._ledger.frame_slots] = picture
        for slot in lost:
            # Not 0 ** alpha, which is one where alpha is zero.
            self._priorities[slot] = 0.0
            self._set_weights(np.array([slot]), np.zeros(1))
        return number


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
