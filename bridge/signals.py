"""Ending on SIGTERM as on ^C, so that sessions are closed and files are finished."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

_LOOK_S = 0.2


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt inside the block (main thread only)."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def wait_to_be_told() -> NoReturn:
    """Sleep until KeyboardInterrupt (main thread only).

    The kernel may hand a signal to any thread, one of Zenoh's too, and that does not wake this one
    from a lock, where it would wait for ever: so it looks again, now and then.
    """
    while True:
        time.sleep(_LOOK_S)
