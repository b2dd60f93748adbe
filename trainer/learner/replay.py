"""The prioritised human-demonstration replay buffer (section IV-C, table A6).

One buffer for what the policy and what the human did (eq. 10, 19). Each picture is stored once:
a transition points at three of them, so 100,000 transitions take 380 MB instead of 1.4 GB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainer.learner.ledger import Ledger
from trainer.learner.sum_tree import Indices, SumTree

FRAME_SHAPE = (45, 80)
COLUMNS = (
    "actions", "rewards", "terminals", "human", "overruled", "penalised", "priorities"
)  # fmt: skip
"""What is kept of a transition beside its pictures."""


@dataclass(frozen=True)
class Batch:
    """A minibatch of ``n`` transitions."""

    indices: Indices
    frames: NDArray[np.uint8]
    """s, [n, 2, 45, 80]."""
    actions: NDArray[np.float32]
    """a, the action that was carried out, [n, action size]."""
    rewards: NDArray[np.float32]
    """r after shaping: the discounted sum over ``spans`` steps, [n]."""
    next_frames: NDArray[np.uint8]
    """s' after those steps, [n, 2, 45, 80]."""
    terminals: NDArray[np.float32]
    """1 where s' ends the episode for good, or the policy's action in s' is overruled and
    penalised; a timeout is not terminal, [n]."""
    human: NDArray[np.bool_]
    """Delta of the first step: whether the human acted, [n]."""
    probabilities: NDArray[np.float64]
    """p(i), the probability with which each was drawn (eq. 20), [n]."""
    spans: NDArray[np.int64] | int = 1
    """Steps from s to s', [n]; or as many in all rows."""
    overruled: NDArray[np.float32] | None = None
    """What the policy would have done where the human acted, else the action, [n, action size]."""
    penalised: NDArray[np.bool_] | None = None
    """Whether the overruled action is penalised (eq. 17), [n]; None: in no row."""


class _Returns(NamedTuple):
    """n-step returns without their bootstrap, [n] each."""

    rewards: NDArray[np.float32]
    lasts: Indices
    """The transitions that they end with."""
    terminals: NDArray[np.float32]
    """1 where nothing is to be bootstrapped from."""
    spans: NDArray[np.int64]


class ReplayBuffer:
    """A ring of transitions, drawn in proportion to priority ** alpha.

    Args:
        capacity: transitions kept (table A6: 1e5).
        action_size: length of an action.
        alpha: priority scaling factor (eq. 20).
        separate: draw from the human's transitions and from the policy's apart, from each as
            often as its share of all (section VII-A: RD2).
        steps: rewards that a drawn transition sums up, at most (n of n-step returns).
        gamma: their discount factor.
        overruled_value: what a penalised action is worth, if a sum that reaches one is to end with
            it; None: a sum goes on with what the human did instead.
    """

    def __init__(
        self,
        capacity: int,
        action_size: int = 1,
        alpha: float = 0.6,
        separate: bool = False,
        steps: int = 1,
        gamma: float = 1.0,
        overruled_value: float | None = None,
    ) -> None:
        self.capacity, self.alpha = capacity, alpha
        self.steps, self.gamma, self.overruled_value = steps, gamma, overruled_value
        self._ledger = Ledger(capacity)
        self._pictures = np.empty((self._ledger.frame_slots, *FRAME_SHAPE), np.uint8)
        self._actions = np.zeros((capacity, action_size), np.float32)
        self._rewards = np.zeros(capacity, np.float32)
        self._terminals = np.zeros(capacity, np.float32)
        self._human = np.zeros(capacity, np.bool_)
        self._overruled = np.zeros((capacity, action_size), np.float32)
        self._penalised = np.zeros(capacity, np.bool_)
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
        overruled: NDArray[np.float32] | None = None,
        penalised: bool = False,
    ) -> None:
        """Store a transition with the highest priority that any other has (algorithm 1).

        Args:
            action: what was carried out.
            reward: after shaping.
            next_frames: what it led to, [2, 45, 80].
            terminal: whether that ends the episode for good.
            human: whether the human acted.
            overruled: the policy's action in its place, if so.
            penalised: whether that action is penalised.
        """
        self._ledger.check_started()
        priority = self._highest_priority()
        slot = self._ledger.add_transition(self._add_picture(next_frames[1]))
        self._actions[slot] = action
        self._rewards[slot] = reward
        self._terminals[slot] = terminal
        self._human[slot] = human
        self._overruled[slot] = action if overruled is None else overruled
        self._penalised[slot] = penalised
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
            **{name: getattr(self, f"_{name}")[:used] for name in COLUMNS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave; the next episode begins with ``start_episode``."""
        self._ledger.load_state_dict(state)
        used, pictures = self._ledger.used, self._ledger.used_frames
        self._pictures[:pictures] = state["pictures"]
        for name in COLUMNS:
            getattr(self, f"_{name}")[:used] = state[name]
        # What was here before must not be drawn any more.
        self._trees = [SumTree(self.capacity) for _ in self._trees]
        alive = self._ledger.alive
        if len(alive):
            self._set_weights(alive, self._priorities[alive] ** self.alpha)

    def _gather(self, indices: Indices) -> Batch:
        returns = self._returns(indices)
        return Batch(
            indices=indices,
            frames=self._pictures[self._places(indices, 0)],
            actions=self._actions[indices],
            rewards=returns.rewards,
            next_frames=self._pictures[self._places(returns.lasts, 1)],
            terminals=returns.terminals,
            human=self._human[indices],
            probabilities=self._probabilities(indices),
            spans=returns.spans,
            overruled=self._overruled[indices],
            penalised=self._penalised[indices],
        )

    def _places(self, indices: Indices, first: int) -> Indices:
        """Where the two pictures from ``first`` on of each transition lie, [n, 2]."""
        return self._ledger.frame_ids[indices, first : first + 2] % self._ledger.frame_slots

    def _returns(self, indices: Indices) -> _Returns:
        """The n-step returns, without their bootstrap, that begin with these transitions.

        A sum ends early where the episode does, for good or by a timeout, and at the newest step.
        It ends for good, too, at an overruled action that is penalised: what the human did there
        instead, and came to, is not what the policy's actions before it were worth.
        """
        sums, lasts = self._rewards[indices], indices
        terminals = self._terminals[indices]
        spans = np.ones(len(indices), np.int64)
        going = np.ones(len(indices), np.bool_)
        for step in range(1, self.steps):
            following = (lasts + 1) % self.capacity
            going &= (terminals == 0.0) & self._ledger.follows(lasts, following)
            if not going.any():
                break
            discount = np.float32(self.gamma**step)
            if self.overruled_value is not None:
                overruled = going & self._penalised[following]
                sums = sums + overruled * (discount * np.float32(self.overruled_value))
                terminals = np.where(overruled, np.float32(1.0), terminals)
                going &= ~overruled
            lasts = np.where(going, following, lasts)
            sums = sums + going * (discount * self._rewards[following])
            terminals = np.where(going, self._terminals[lasts], terminals)
            spans += going
        return _Returns(sums.astype(np.float32), lasts, terminals, spans)

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
