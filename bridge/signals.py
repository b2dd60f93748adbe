"""Ending on SIGTERM as on ^C, so that sessions are closed and files are finished."""

from __future__ import annotations

import time
from typing import NoReturn

from edge_runtime.cli import sigterm_as_interrupt

__all__ = ["sigterm_as_interrupt", "wait_to_be_told"]

_LOOK_S = 0.2


def wait_to_be_told() -> NoReturn:
    """Sleep until KeyboardInterrupt (main thread only).

    The kernel may hand a signal to any thread, one of Zenoh's too, and that does not wake this one
    from a lock, where it would wait for ever: so it looks again, now and then.
    """
    while True:
        time.sleep(_LOOK_S)
