"""Seeds: one run seed gives independent streams and episodes that never meet test episodes."""

from __future__ import annotations

import numpy as np

TRAINING, VALIDATION, EXPLORATION, REPLAY, HUMAN_EPISODES, HUMAN_BATCHES, GUIDANCE = range(7)
"""Purposes, each with a stream of its own."""
SITTINGS = 7
"""The same, of the episodes that a person drives without learning."""


def episode_seed(run_seed: int, purpose: int, episode: int) -> int:
    """The environment's seed for an episode: above 2**31, so that tests may use small numbers."""
    (word,) = np.random.SeedSequence([run_seed, purpose, episode]).generate_state(1)
    return (1 << 31) + int(word) // 2


def stream(run_seed: int, purpose: int) -> np.random.Generator:
    """A random stream for one purpose."""
    return np.random.default_rng([run_seed, purpose])
