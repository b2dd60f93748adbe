"""The books of a replay buffer: where pictures and transitions go, and which are forgotten."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

FRAMES_PER_TRANSITION = 1.05
"""Stored pictures for each transition: one, and one more at the start of each episode."""


AddPicture = Callable[[NDArray[np.uint8]], int]
"""Stores a picture [45, 80]; gives its running number."""


class Ledger:
    """Running numbers of pictures and transitions, and the rings they are kept in.

    Args:
        capacity: transitions kept.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.frame_slots = int(capacity * FRAMES_PER_TRANSITION) + 3
        self.added = 0
        self.frames_added = 0
        self.frame_ids = np.zeros((capacity, 3), np.int64)
        """The running numbers of each transition's three pictures, oldest first."""
        self.oldest = 0
        """Running number of the oldest transition that is not forgotten."""
        self._current: tuple[int, int] | None = None

    def __len__(self) -> int:
        return self.added - self.oldest

    @property
    def used(self) -> int:
        """Slots that hold or held a transition."""
        return min(self.added, self.capacity)

    @property
    def used_frames(self) -> int:
        """Picture slots that hold a picture."""
        return min(self.frames_added, self.frame_slots)

    @property
    def alive(self) -> NDArray[np.int64]:
        """Slots of the transitions that are not forgotten, oldest first."""
        return np.arange(self.oldest, self.added, dtype=np.int64) % self.capacity

    def start_episode(self, frames: NDArray[np.uint8], add_picture: AddPicture) -> None:
        """Take the first observation [2, 45, 80] of an episode; a picture seen twice once only."""
        older = add_picture(frames[0])
        newer = older if np.array_equal(frames[0], frames[1]) else add_picture(frames[1])
        self._current = (older, newer)

    def check_started(self) -> None:
        """Raise RuntimeError unless an episode has begun."""
        if self._current is None:
            raise RuntimeError("start_episode comes before add")

    def add_picture(self) -> tuple[int, list[int]]:
        """Number a new picture; it goes to that number modulo ``frame_slots``.

        Returns:
            The number, and the slots of transitions that are forgotten because this picture
            takes the place of theirs.
        """
        number = self.frames_added
        self.frames_added += 1
        return number, list(self._forget(number - self.frame_slots))

    def add_transition(self, newest: int) -> int:
        """Number a transition that led to picture ``newest``; returns its slot."""
        self.check_started()
        assert self._current is not None
        older, newer = self._current
        slot = self.added % self.capacity
        self.frame_ids[slot] = older, newer, newest
        self.added += 1
        self.oldest = max(self.oldest, self.added - self.capacity)
        self._current = (newer, newest)
        return slot

    def follows(self, slots: NDArray[np.int64], following: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each transition begins with the picture that another ended with, [n].

        Pictures have running numbers, so no other episode's transition does, nor a forgotten one.
        """
        return self.frame_ids[slots, 2] == self.frame_ids[following, 1]

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on."""
        return {
            "added": self.added,
            "frames_added": self.frames_added,
            "oldest": self.oldest,
            "frame_ids": self.frame_ids[: self.used],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what ``state_dict`` gave; the next episode begins with ``start_episode``."""
        self.added = state["added"]
        self.frames_added = state["frames_added"]
        self.oldest = state["oldest"]
        self.frame_ids[: self.used] = state["frame_ids"]
        self._current = None

    def _forget(self, lost_picture: int) -> Iterator[int]:
        while len(self) and self.frame_ids[self.oldest % self.capacity, 0] <= lost_picture:
            yield self.oldest % self.capacity
            self.oldest += 1
