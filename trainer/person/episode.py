"""An episode's transitions, kept back until it is known whether the person throws it away."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from trainer.training.delayed import Store
from trainer.training.learning import Observation


class KeptBack:
    """A ``Store`` that stores when it is told to.

    Args:
        store: where the transitions of an episode go that is not discarded.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._calls: list[Callable[[], None]] = []

    def start_episode(self, observation: Observation) -> None:
        """Take an episode's first observation."""
        self._calls.append(partial(self._store.start_episode, observation))

    def add(self, *transition: Any, **guidance: Any) -> None:
        """Take a transition; arguments as ``Store.add``."""
        self._calls.append(partial(self._store.add, *transition, **guidance))

    def release(self, discarded: bool) -> None:
        """Store what was taken since the last call, or forget it."""
        calls, self._calls = self._calls, []
        for store in () if discarded else calls:
            store()
