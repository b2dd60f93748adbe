"""Messages under way, ordered by when they arrive. Pure: the caller says what time it is."""

from __future__ import annotations

import heapq
from typing import Generic, TypeVar

Message = TypeVar("Message")


class EventHeap(Generic[Message]):
    """A priority queue on arrival time; messages with the same time keep their order."""

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, Message]] = []
        self._pushed = 0

    def push(self, arrival_s: float, message: Message) -> None:
        """Add a message that arrives at ``arrival_s``."""
        heapq.heappush(self._entries, (arrival_s, self._pushed, message))
        self._pushed += 1

    def pop_due(self, now_s: float) -> tuple[float, Message] | None:
        """Take the earliest message that has arrived by ``now_s``, with its time; None if none."""
        if not self._entries or self._entries[0][0] > now_s:
            return None
        arrival_s, _, message = heapq.heappop(self._entries)
        return arrival_s, message

    def next_arrival_s(self) -> float | None:
        """Return when the earliest message arrives; None if nothing is under way."""
        return self._entries[0][0] if self._entries else None

    def clear(self) -> None:
        """Forget everything under way (an episode has ended)."""
        self._entries.clear()
