"""A sum tree: sampling in proportion to a weight, and changing weights, in O(log n)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


class SumTree:
    """Non-negative weights of ``capacity`` leaves, with their sums in a binary tree.

    All operations take arrays, so that a minibatch costs a few numpy calls a level and not a
    Python loop. Node 1 is the root; the children of node k are 2k and 2k + 1.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._leaves = 1 << max(capacity - 1, 1).bit_length()
        self._nodes = np.zeros(2 * self._leaves)

    @property
    def total(self) -> float:
        """The sum of all weights."""
        return float(self._nodes[1])

    def __getitem__(self, indices: Indices) -> NDArray[np.float64]:
        return self._nodes[self._leaves + indices]

    def __setitem__(self, indices: Indices, weights: NDArray[np.float64]) -> None:
        """Set weights, shape [n]; of an index named twice, the last one counts."""
        nodes = self._leaves + np.asarray(indices, dtype=np.int64)
        self._nodes[nodes] = weights
        while nodes[0] > 1:
            # Parents are summed anew from both children: repeated updates cannot drift.
            nodes = np.unique(nodes >> 1)
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def find(self, masses: NDArray[np.float64]) -> Indices:
        """The leaves in whose share of the total the given cumulative masses fall, shape [n]."""
        nodes = np.ones(len(masses), dtype=np.int64)
        left_over = np.array(masses, dtype=np.float64)
        while nodes[0] < self._leaves:
            nodes *= 2
            left = self._nodes[nodes]
            # An empty right side is never entered, however rounding turned out.
            right = (left_over >= left) & (self._nodes[nodes + 1] > 0.0)
            left_over -= np.where(right, left, 0.0)
            nodes += right
        return nodes - self._leaves

    def sample(self, count: int, random: np.random.Generator) -> Indices:
        """``count`` leaves, stratified: one from each of ``count`` equal parts of the total."""
        masses = (np.arange(count) + random.random(count)) * (self.total / count)
        return self.find(masses)
