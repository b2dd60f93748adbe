"""Real-time delays: an event heap with a thread that acts when a message is due."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from edge_runtime.latency.event_heap import EventHeap

Action = Callable[[], None]


class DelayLine:
    """Runs actions at their time on the monotonic clock, on a thread of its own.

    ``close`` ends the thread; as a daemon, a forgotten one does not hold up the process's end.
    What an action raises ends the line, and is raised by the next ``push`` or ``close``.
    """

    def __init__(self) -> None:
        self._heap: EventHeap[Action] = EventHeap()
        self._changed = threading.Condition()
        self._closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="delay-line", daemon=True)
        self._thread.start()

    def push(self, release_s: float, action: Action) -> None:
        """Run ``action`` at ``release_s`` (monotonic seconds); at once if that has passed."""
        with self._changed:
            self._raise_failure()
            self._heap.push(release_s, action)
            self._changed.notify()

    def clear(self) -> None:
        """Forget what is still under way."""
        with self._changed:
            self._heap.clear()

    def close(self) -> None:
        """Stop the thread and wait for it."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._raise_failure()

    def _run(self) -> None:
        try:
            while (action := self._next_action()) is not None:
                action()
        except Exception as error:  # Handed to whoever uses the line.
            self._failure = error

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _next_action(self) -> Action | None:
        """Sleep until an action is due and return it; None once the line is closed."""
        with self._changed:
            while not self._closed:
                due = self._heap.pop_due(time.monotonic())
                if due is not None:
                    return due[1]
                next_s = self._heap.next_arrival_s()
                self._changed.wait(None if next_s is None else next_s - time.monotonic())
        return None
