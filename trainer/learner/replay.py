"""The prioritised human-demonstration replay buffer (section IV-C, table A6).

One buffer holds the policy's and the human's transitions (eq. 10, 19). Each picture is stored once:
a transition points at three of them, so 100,000 transitions take 380 MB instead of 1.4 GB. Of other
observations it points at two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float32]  # In [-1, 1], [action size]
Observation = NDArray[Any]
"""The two frames, or another environment's array, structured if it has several entries."""
Indices = NDArray[np.int64]


class ReplayLayout(NamedTuple):
    """Shape and type of an observation's array."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]  # A structured one for several entries
    stacked: bool = False
    """The observation is [older, newer], and its newer half is the next one's older half."""


FRAMES_LAYOUT = ReplayLayout((2, 45, 80), np.dtype(np.uint8), stacked=True)
FRAMES_PER_TRANSITION = 1.05
"""Stored pictures for each transition: one, and one more at the start of each episode."""
COLUMNS = ("actions", "rewards", "terminals", "human", "overruled", "penalised", "priorities")
"""Arrays of a transition's fields, beside its pictures."""
AHEAD = "foreseen_"  # Prefix of the foreseen buffer's keys in a checkpoint


@dataclass(frozen=True)
class Transition:
    """One control period, as it happened at the vehicle: what replay and recordings take."""

    observation: Observation  # s
    action: Action  # a, the action that was carried out
    reward: float  # The environment's; a learner shapes it (eq. 17)
    next_observation: Observation  # s'
    terminal: bool  # Whether s' ends the episode for good; a timeout does not
    truncated: bool = False  # Whether the episode ends here although s' is not terminal
    human: bool = False  # Delta: whether the human acted
    overruled: Action | None = None
    """The policy's action, overruled where the human acted; None: the same as ``action``."""
    penalised: bool = False  # Whether a penalised intervention begins here (eq. 17)
    foreseen: tuple[Observation, ...] = ()
    """The observation, and those predicted for the overruled action; empty: no prediction."""


@dataclass(frozen=True)
class Batch:
    """A minibatch of ``n`` transitions."""

    indices: Indices
    frames: NDArray[Any]  # s, [n, 2, 45, 80], or [n, ...] of another layout
    actions: NDArray[np.float32]  # a, the action that was carried out, [n, action size]
    rewards: NDArray[np.float32]  # r after shaping: the discounted sum over ``spans`` steps, [n]
    next_frames: NDArray[Any]  # s' after those steps, shaped as ``frames``
    terminals: NDArray[np.float32]
    """1 where s' ends the episode for good, or the policy's action in s' is overruled and
    penalised; a timeout is not terminal, [n]."""
    human: NDArray[np.bool_]  # Delta of the first step: whether the human acted, [n]
    probabilities: NDArray[np.float64]
    """p(i), the probability with which each was drawn (eq. 20), [n]."""
    spans: NDArray[np.int64]  # Steps from s to s', [n]
    overruled: NDArray[np.float32]
    """The policy's action where the human acted, else the action, [n, action size]."""
    penalised: NDArray[np.bool_]  # Whether the overruled action is penalised (eq. 17), [n]
    foreseen: Batch | None = None
    """A second batch, whose ``next_frames`` are predictions for overruled actions."""
    shown: Batch | None = None
    """A further batch of human transitions alone, for cloning."""


class ReplayBuffer:
    """A ring of transitions, drawn in proportion to priority ** alpha.

    Pictures and transitions have running numbers, and a ring of slots each. A transition is
    forgotten with the oldest of its pictures. An observation that is not stacked counts as one
    picture.

    Args:
        capacity: transitions kept (table A6: 1e5).
        action_size: length of an action.
        alpha: priority scaling factor (eq. 20).
        separate: draw the human's transitions and the policy's separately, each kind as often as
            its share of all (section VII-A: RD2).
        steps: maximum number of rewards that a drawn transition sums up (n of n-step returns).
        gamma: their discount factor.
        overruled_value: value of a penalised action, with which an n-step return ends there; None:
            the return goes on with the human's action.
        layout: shape and type of the observations.
        human_share: share of the human's transitions in a minibatch once there are both kinds,
            which are then drawn separately; 0: not fixed.
        foresees: also store and draw the observations predicted for overruled actions.
        shown: size of the further batch of human transitions, drawn uniformly; 0: none.
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
        layout: ReplayLayout = FRAMES_LAYOUT,
        human_share: float = 0.0,
        foresees: bool = False,
        shown: int = 0,
    ) -> None:
        self.capacity, self.alpha, self.human_share = capacity, alpha, human_share
        self.shown = shown
        self.steps, self.gamma, self.overruled_value = steps, gamma, overruled_value
        self.reward_scale = 1.0
        """Factor on rewards when they are drawn."""
        self._largest_return, self._episode_rewards = 0.0, list[float]()
        self.added = self._frames_added = 0  # Since the run began
        self._oldest = 0  # Running number of the oldest transition that is not forgotten
        self._stacked, self._frame_slots = layout.stacked, int(capacity * FRAMES_PER_TRANSITION) + 3
        shape = layout.shape[1:] if layout.stacked else layout.shape
        self._pictures = np.empty((self._frame_slots, *shape), layout.dtype)
        self._frame_ids = np.zeros((capacity, 2 + layout.stacked), np.int64)
        """The running numbers of each transition's three (or two) pictures, oldest first."""
        self._current: tuple[int, ...] | None = None
        self._actions = np.zeros((capacity, action_size), np.float32)
        self._rewards = np.zeros(capacity, np.float32)
        self._terminals = np.zeros(capacity, np.float32)
        self._human = np.zeros(capacity, np.bool_)
        self._overruled = np.zeros((capacity, action_size), np.float32)
        self._penalised = np.zeros(capacity, np.bool_)
        self._priorities = np.zeros(capacity)
        self._weights = np.zeros(capacity)  # priority ** alpha; 0 where forgotten
        self._separate = separate or human_share > 0.0
        self._foreseen: ReplayBuffer | None = None
        if foresees:
            self._foreseen = ReplayBuffer(capacity, action_size, alpha=0.0, layout=layout)

    def __len__(self) -> int:
        return self.added - self._oldest

    @property
    def alive(self) -> Indices:
        """Slots of the transitions that are not forgotten, oldest first."""
        return np.arange(self._oldest, self.added, dtype=np.int64) % self.capacity

    @property
    def _used(self) -> int:
        """Number of slots that hold or held a transition."""
        return min(self.added, self.capacity)

    @property
    def human_count(self) -> int:
        """Number of the human's transitions that are not forgotten."""
        return int(self._human[self.alive].sum())

    def mean_priorities(self) -> tuple[float, float]:
        """Return the mean priorities of the policy's and the human's transitions (nan: none)."""
        alive = self.alive
        human, priorities = self._human[alive], self._priorities[alive]
        return _mean(priorities[~human]), _mean(priorities[human])

    def end_episode(self) -> None:
        """End the episode: the next transition does not follow the last one."""
        self._current = None
        self._largest_return, self._episode_rewards = self.largest_return, []

    def add(self, transition: Transition) -> None:
        """Store a transition with the highest priority in its buffer (algorithm 1)."""
        if self._current is None:
            self._current = self._begin(transition.observation)
        others = self._priorities[: self._used]
        if self._separate:  # Only the priorities of its own kind
            others = others[self._human[: self._used] == transition.human]
        priority = float(others.max(initial=0.0)) or 1.0
        following = transition.next_observation
        newest = self._add_picture(following[1] if self._stacked else following)
        slot = self.added % self.capacity
        self._frame_ids[slot] = *self._current, newest
        self._current = (*self._current[1:], newest)
        self.added += 1
        self._oldest = max(self._oldest, self.added - self.capacity)
        overruled = transition.overruled
        self._actions[slot] = transition.action
        self._rewards[slot] = transition.reward
        self._episode_rewards.append(transition.reward)
        self._terminals[slot] = transition.terminal
        self._human[slot] = transition.human
        self._overruled[slot] = transition.action if overruled is None else overruled
        self._penalised[slot] = transition.penalised
        self.update_priorities(np.array([slot]), np.array([priority]))
        if self._foreseen is not None and transition.foreseen:
            self._foreseen.end_episode()
            for before, after in pairwise(transition.foreseen):
                ahead = replace(transition, observation=before, next_observation=after, reward=0.0,
                                terminal=True, human=True, penalised=False)  # fmt: skip
                self._foreseen.add(ahead)

    def _begin(self, frames: Observation) -> tuple[int, ...]:
        """Store an episode's first observation; two equal pictures only once."""
        if not self._stacked:
            return (self._add_picture(frames),)
        older = newer = self._add_picture(frames[0])
        if not np.array_equal(frames[0], frames[1]):
            newer = self._add_picture(frames[1])
        return older, newer

    def observations(self, most: int) -> NDArray[Any]:
        """Return at most ``most`` stored observations [n, ...], evenly spaced by age."""
        return self._frames(self.alive[:: -(-len(self) // most)], 0)

    @property
    def largest_return(self) -> float:
        """Largest absolute discounted sum of rewards, unscaled, up to an episode's latest step."""
        return max(self._largest_return, self._running_return())

    def _running_return(self) -> float:
        """Return the largest such sum of the episode under way."""
        discounted_sum, largest = 0.0, 0.0
        for reward in reversed(self._episode_rewards):
            discounted_sum = reward + self.gamma * discounted_sum
            largest = max(largest, abs(discounted_sum))
        return largest

    def sample(self, count: int, random: np.random.Generator) -> Batch:
        """Draw a minibatch by priority."""
        batch = self._gather(self._draw(count, random))
        if self._foreseen:  # Neither None nor empty
            batch = replace(batch, foreseen=self._foreseen.sample(count, random))
        if self.shown and self.human_count:
            batch = replace(batch, shown=self.show(self.shown, random))
        return batch

    def show(self, count: int, random: np.random.Generator) -> Batch:
        """Draw human transitions uniformly; there must be at least one."""
        humans = self.alive[self._human[self.alive]]
        return self._gather(random.choice(humans, count))

    def _draw(self, count: int, random: np.random.Generator) -> Indices:
        # Stratified: one draw from each of `count` equal parts.
        strata = (np.arange(count) + random.random(count)) / count
        weights, human = self._weights[: self._used], self._human[: self._used]
        if not self._separate:
            return _find(weights, strata)
        # Strata over both kinds: each kind gets its share of the samples, to within one.
        policys_share = 1.0 - self._humans_share()
        policys = strata[strata < policys_share] / policys_share
        humans = (strata[strata >= policys_share] - policys_share) / (1.0 - policys_share)
        parts = (~human, policys), (human, humans)
        return np.concatenate(
            [_find(weights * own, shares) for own, shares in parts if len(shares)]
        )

    def update_priorities(self, indices: Indices, priorities: NDArray[np.float64]) -> None:
        """Set the priorities p of drawn transitions (eq. 21)."""
        if not np.all(np.isfinite(priorities)) or np.any(priorities < 0):
            raise ValueError("a priority must be finite and not negative")
        self._priorities[indices] = priorities
        self._weights[indices] = priorities**self.alpha

    def state_dict(self) -> dict[str, Any]:
        """Return the state to resume from, without the unused part of the arrays."""
        columns = {name: getattr(self, f"_{name}")[: self._used] for name in COLUMNS}
        ahead = {} if self._foreseen is None else self._foreseen.state_dict()
        named = {f"{AHEAD}{name}": value for name, value in ahead.items()}
        return {
            "added": self.added,
            "frames_added": self._frames_added,
            "oldest": self._oldest,
            "reward_scale": self.reward_scale,
            "largest_return": self.largest_return,
            "frame_ids": self._frame_ids[: self._used],
            # Bytes: a checkpoint holds no structured arrays.
            "pictures": self._pictures[: self._frames_added].view(np.uint8),
            **columns,
            **named,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``; the next transition begins an episode."""
        self.added, self._oldest = state["added"], state["oldest"]
        self._frames_added = state["frames_added"]
        self.reward_scale, self._largest_return = state["reward_scale"], state["largest_return"]
        self._frame_ids[: self._used] = state["frame_ids"]
        self._pictures[: self._frames_added].view(np.uint8)[:] = state["pictures"]
        self._current = None
        for name in COLUMNS:
            getattr(self, f"_{name}")[: self._used] = state[name]
        # Earlier contents must not be drawn any more.
        self._weights[:] = 0.0
        self.update_priorities(self.alive, self._priorities[self.alive])
        if self._foreseen is not None:
            own = {n.removeprefix(AHEAD): v for n, v in state.items() if n.startswith(AHEAD)}
            self._foreseen.load_state_dict(own)

    def _gather(self, indices: Indices) -> Batch:
        rewards, lasts, terminals, spans = self._returns(indices)
        return Batch(
            indices=indices,
            frames=self._frames(indices, 0),
            actions=self._actions[indices],
            rewards=rewards,
            next_frames=self._frames(lasts, 1),
            terminals=terminals,
            human=self._human[indices],
            probabilities=self._probabilities(indices),
            spans=spans,
            overruled=self._overruled[indices],
            penalised=self._penalised[indices],
        )

    def _returns(
        self, indices: Indices
    ) -> tuple[NDArray[np.float32], Indices, NDArray[np.float32], NDArray[np.int64]]:
        """Sum up the n-step returns that begin with these transitions, without their bootstrap.

        Returns, [n] each: the sums, the indices of their last transitions, 1 where nothing is
        bootstrapped, and the number of steps.

        A sum ends early at the episode's end, terminal or a timeout, and at the newest step. At a
        penalised overruled action it ends without a bootstrap: the human's action there, and its
        result, say nothing about the policy's earlier actions.
        """
        scale = np.float32(self.reward_scale)
        sums: NDArray[np.floating] = scale * self._rewards[indices]
        lasts = indices
        terminals: NDArray[np.float32] = self._terminals[indices]
        spans = np.ones(len(indices), np.int64)
        going = np.ones(len(indices), np.bool_)
        for step in range(1, self.steps):
            following = (lasts + 1) % self.capacity
            going &= (terminals == 0.0) & self._follows(lasts, following)
            if not going.any():
                break
            discount = np.float32(self.gamma**step)
            if self.overruled_value is not None:
                overruled = going & self._penalised[following]
                sums = sums + overruled * (discount * np.float32(self.overruled_value))
                terminals = np.where(overruled, np.float32(1.0), terminals)
                going &= ~overruled
            lasts = np.where(going, following, lasts)
            sums = sums + going * (discount * (scale * self._rewards[following]))
            terminals = np.where(going, self._terminals[lasts], terminals)
            spans += going
        return sums.astype(np.float32), lasts, terminals, spans

    def _probabilities(self, indices: Indices) -> NDArray[np.float64]:
        weights, human = self._weights[: self._used], self._human[: self._used]
        if not self._separate:
            return weights[indices] / weights.sum()
        share = self._humans_share()
        sums = (max(weights[own].sum(), 1e-300) for own in (~human, human))
        policys, humans = (weights[indices] / total for total in sums)
        return np.where(human[indices], share * humans, (1.0 - share) * policys)

    def _humans_share(self) -> float:
        """The human's share of a minibatch where the two kinds are drawn separately."""
        stored = self.human_count / len(self)
        return self.human_share if self.human_share and 0.0 < stored < 1.0 else stored

    def _frames(self, slots: Indices, first: int) -> NDArray[Any]:
        """Gather s (``first`` is 0) or s' (1) of each transition, [n, 2, 45, 80]."""
        pictures = slice(first, first + 2) if self._stacked else first
        return self._pictures[self._frame_ids[slots, pictures] % self._frame_slots]

    def _follows(self, slots: Indices, following: Indices) -> NDArray[np.bool_]:
        """Whether each ``following`` continues its transition's episode, [n].

        It then begins with the picture that the transition ended with; pictures are numbered, so
        no other episode's and no forgotten transition does.
        """
        return self._frame_ids[slots, -1] == self._frame_ids[following, -2]

    def _add_picture(self, picture: NDArray[Any]) -> int:
        """Store a picture, forget transitions that used its slot; return the picture's number."""
        number = self._frames_added
        self._frames_added += 1
        self._pictures[number % self._frame_slots] = picture
        overwritten, forgotten = number - self._frame_slots, []
        while len(self) and self._frame_ids[self._oldest % self.capacity, 0] <= overwritten:
            forgotten.append(self._oldest % self.capacity)
            self._oldest += 1
        if forgotten:
            # A weight of 0, not 0 ** alpha, which is 1 where alpha is 0.
            self._priorities[forgotten] = self._weights[forgotten] = 0.0
        return number


def _find(weights: NDArray[np.float64], shares: NDArray[np.float64]) -> Indices:
    """Return the indices at which the cumulative weights pass shares (0 to below 1) of the sum."""
    sums = np.cumsum(weights)
    indices = np.searchsorted(sums, shares * sums[-1], side="right")
    return np.minimum(indices, np.searchsorted(sums, sums[-1]))  # Rounding may exceed the last.


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
