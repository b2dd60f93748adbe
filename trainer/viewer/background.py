"""A thread that draws what the loop hands over."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from bridge.rerun.sinks import ViewerGone
from trainer.viewer.entries import Entry

MOST_WAITING = 500
"""Entries, some 50 s of pictures: a view that is slower loses some, and the loop nothing."""


Draw = Callable[[Entry], None]


class Background:
    """Opens a view, draws each entry in order, and closes it, in a thread of its own.

    Args:
        opened: a view that may take its time; what it yields draws an entry. What any of it raises
            is told once, and ends the drawing, not the run.
    """

    def __init__(self, opened: Callable[[], AbstractContextManager[Draw]]) -> None:
        self.dropped = 0
        self._opened = opened
        self._queue: queue.Queue[Entry | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Hand an entry over; never blocks."""
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Draw what still waits, and close the view."""
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        entries: Iterator[Entry] = iter(self._queue.get, None)
        try:
            with self._opened() as draw:
                for entry in entries:
                    draw(entry)
        except BaseException as error:  # a panic of rerun's Rust is no Exception
            why = error.why if isinstance(error, ViewerGone) else error
            print(f"viewer gone; the run is unharmed: {why}", file=sys.stderr, flush=True)
            for _ in entries:
                pass  # The queue is emptied all the same: close() must not wait for ever.
