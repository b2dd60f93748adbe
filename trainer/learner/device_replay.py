"""The replay buffer of ``replay.py`` in an accelerator's memory: drawn from without asking it.

Nothing here waits for the device, except ``state_dict`` and ``mean_priorities``: no value is read
back, and no shape depends on one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.learner.drawing import last_for_all, pick
from trainer.learner.ledger import LOST_AT_ONCE, Ledger
from trainer.learner.minibatch import Minibatch
from trainer.learner.replay import FRAME_SHAPE
from trainer.learner.staging import Staging

COLUMNS = ("frame_ids", "actions", "rewards", "terminals", "human")
"""What a transition is, beside its priority; each is stored as it comes."""


class DeviceReplay:
    """A ring of transitions, drawn in proportion to priority ** alpha (eq. 20).

    Behind the last slot are spare ones of priority zero, up to a square number: one of them takes
    what belongs nowhere, and drawing looks at rows first and then within a row.

    Args:
        capacity: transitions kept (table A6: 1e5).
        action_size: length of an action.
        alpha: priority scaling factor (eq. 20).
        device: where all is kept.
        separate: draw from the human's transitions and from the policy's apart, as
            ``ReplayBuffer`` does.
    """

    def __init__(
        self,
        capacity: int,
        action_size: int = 1,
        alpha: float = 0.6,
        device: str = "cpu",
        separate: bool = False,
    ) -> None:
        self.separate = separate
        self.capacity, self.alpha, self.device = capacity, alpha, torch.device(device)
        self._ledger = Ledger(capacity)
        self._side = math.isqrt(capacity) + 1
        self._staging = Staging(_layout(action_size), self.device)
        slots = self._side**2
        self._pictures = self._zeros(self._ledger.frame_slots, torch.uint8, *FRAME_SHAPE)
        self.priorities = self._zeros(slots, torch.float64)
        """p of each slot; zero where nothing is, or is no longer."""
        self._columns = {
            name: self._zeros(slots, field.dtype, *field.shape[1:])
            for name, field in self._staging.fields.items()
            if name in COLUMNS
        }
        self.store: Callable[[], None] = self.store_record
        """What is done with a record once it is sent; may be replaced by the same captured."""

    def __len__(self) -> int:
        return len(self._ledger)

    @property
    def added(self) -> int:
        """Transitions stored since the run began."""
        return self._ledger.added

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
        record = self._staging.row()
        record["empty"] = len(self) == 0
        newest = self._enter_picture(record, next_frames[1])
        slot = self._ledger.add_transition(newest)
        record["slot"] = slot
        record["frame_ids"] = self._ledger.frame_ids[slot]
        record["actions"] = action
        record["rewards"], record["terminals"], record["human"] = reward, terminal, human
        self._staging.send()
        self.store()

    def store_record(self) -> None:
        """Store the record that was sent; doing so again changes nothing."""
        record = self._staging.fields
        slot = record["slot"]
        highest = torch.where(record["empty"], 1.0, self.priorities.max())
        self._pictures.index_copy_(0, record["picture_slot"], record["picture"])
        self.priorities.index_fill_(0, record["lost"], 0.0)
        self.priorities.index_copy_(0, slot, highest * (slot < self.capacity))
        for name, column in self._columns.items():
            column.index_copy_(0, slot, record[name])

    def draw(self, count: int, generator: torch.Generator | None) -> tuple[Tensor, Minibatch]:
        """Draw a minibatch by priority: its slots [count], and what is in them.

        Stratified as ``SumTree.sample`` is: one from each of ``count`` equal parts of the total.
        """
        # Of priority zero are the forgotten; 0 ** alpha is one where alpha is zero.
        weights = torch.where(self.priorities > 0, self.priorities**self.alpha, 0.0)
        human = self._columns["human"]
        kinds = [weights * ~human, weights * human] if self.separate else [weights]
        tables = torch.stack(kinds).view(-1, self._side, self._side)
        rows = tables.sum(dim=2)
        totals = rows.sum(dim=1)
        strata = torch.arange(count, device=self.device) + torch.rand(
            count, generator=generator, device=self.device, dtype=torch.float64
        )
        kind, share, strata = self._kinds(weights, human, strata / count)
        row, left_over = pick(rows[kind], strata * totals[kind])
        column, _ = pick(tables[kind, row], left_over)
        indices = row * self._side + column
        return indices, self._gather(indices, share * weights[indices] / totals[kind])

    def _kinds(
        self, weights: Tensor, human: Tensor, strata: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Whose transitions the samples are of [n], those' share, and each one's place there."""
        if not self.separate:
            return torch.zeros_like(strata, dtype=torch.int64), torch.ones_like(strata), strata
        alive = weights > 0
        humans = (alive & human).sum().double() / alive.sum()
        shares = torch.stack([1.0 - humans, humans])
        kind = (strata >= shares[0]).long()
        return kind, shares[kind], (strata - kind * shares[0]) / shares[kind]

    def set_priorities(self, indices: Tensor, priorities: Tensor) -> None:
        """Set the priorities p [n] of drawn transitions (eq. 21).

        Of a slot named twice the last one counts; they differ by the noise of the smoothing.
        """
        agreed = last_for_all(indices, priorities.double())
        self.priorities.index_copy_(0, indices, agreed)

    def priority_means(self) -> Tensor:
        """Mean priority of the policy's and of the human's transitions [2] (nan where none)."""
        slots = torch.arange(len(self.priorities), device=self.device)
        age = (slots - self._ledger.oldest) % self.capacity
        alive = (age < len(self)) & (slots < self.capacity)
        human = self._columns["human"]
        sums = [
            torch.stack([torch.where(mask, self.priorities, 0.0).sum(), mask.sum()])
            for mask in (alive & ~human, alive & human)
        ]
        return torch.stack([total / number for total, number in sums])

    def mean_priorities(self) -> tuple[float, float]:
        """``priority_means``, read back."""
        policy, human = self.priority_means().tolist()
        return policy, human

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, as ``ReplayBuffer`` gives it."""
        used, pictures = self._ledger.used, self._ledger.used_frames
        columns = {name: column[:used].cpu().numpy() for name, column in self._columns.items()}
        return {
            **columns,
            **self._ledger.state_dict(),
            "pictures": self._pictures[:pictures].cpu().numpy(),
            "priorities": self.priorities[:used].cpu().numpy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what this or a ``ReplayBuffer`` gave; ``start_episode`` comes next."""
        self._ledger.load_state_dict(state)
        used, pictures = self._ledger.used, self._ledger.used_frames
        self._pictures[:pictures] = torch.from_numpy(state["pictures"]).to(self.device)
        self.priorities.zero_()
        self.priorities[:used] = torch.from_numpy(state["priorities"]).to(self.device)
        for name, column in self._columns.items():
            column[:used] = torch.from_numpy(state[name]).to(self.device)

    def _zeros(self, slots: int, dtype: torch.dtype, *shape: int) -> Tensor:
        return torch.zeros(slots, *shape, dtype=dtype, device=self.device)

    def _gather(self, indices: Tensor, probabilities: Tensor) -> Minibatch:
        columns = {name: column[indices] for name, column in self._columns.items()}
        pictures = self._pictures[columns.pop("frame_ids") % self._ledger.frame_slots]
        return Minibatch(
            frames=pictures[:, :2],
            next_frames=pictures[:, 1:],
            probabilities=probabilities,
            **columns,
        )

    def _add_picture(self, picture: NDArray[np.uint8]) -> int:
        record = self._staging.row()
        number = self._enter_picture(record, picture)
        record["slot"] = self.capacity
        self._staging.send()
        self.store()
        return number

    def _enter_picture(self, record: Any, picture: NDArray[np.uint8]) -> int:
        """Write a picture, and what is forgotten for it, into a record; its running number."""
        number, lost = self._ledger.add_picture()
        record["picture"] = picture
        record["picture_slot"] = number % self._ledger.frame_slots
        record["lost"] = self.capacity
        record["lost"][: len(lost)] = lost
        return number


def _layout(action_size: int) -> np.dtype[np.void]:
    """One picture, and the transition that led to it if there is one."""
    return np.dtype(
        [
            ("picture_slot", np.int64, (1,)),
            ("lost", np.int64, (LOST_AT_ONCE,)),
            ("slot", np.int64, (1,)),
            ("frame_ids", np.int64, (1, 3)),
            ("actions", np.float32, (1, action_size)),
            ("rewards", np.float32, (1,)),
            ("terminals", np.float32, (1,)),
            ("human", np.bool_, (1,)),
            ("empty", np.bool_, (1,)),
            ("picture", np.uint8, (1, *FRAME_SHAPE)),
        ]
    )
