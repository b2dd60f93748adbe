"""A thread that draws what the loop hands over."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable

from trainer.viewer.entries import Entry

MOST_WAITING = 500
"""Entries, some 50 s of pictures: a view that is slower loses some, and the loop nothing."""


class Background:
    """Calls ``draw`` with each entry, in order, in a thread of its own.

    Args:
        draw: may take its time. What it raises is told once, and ends the drawing, not the run.
    """

    def __init__(self, draw: Callable[[Entry], None]) -> None:
        self.dropped = 0
        self._draw = draw
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
        """Draw what still waits, and end."""
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        drawing = True
        while (entry := self._queue.get()) is not None:
            if not drawing:
                continue  # The queue is emptied all the same: close() must not wait for ever.
            try:
                self._draw(entry)
            except BaseException as error:  # a panic of rerun's Rust is no Exception
                drawing = False
                print(f"the view ends, the training goes on: {error}", file=sys.stderr)
