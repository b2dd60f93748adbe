"""^C and SIGTERM end long work as quitting does: with everything kept."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def quit_on_signals(ask: Callable[[], bool]) -> Iterator[None]:
    """Let the first signal ask for the end.

    A second one ends the process as ever, and so does the first if nobody heeds it any more.

    Args:
        ask: asks for it; whether somebody will heed.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def stop(number: int, frame: Any) -> None:
        for name, handler in before.items():
            signal.signal(name, handler)
        if not ask():
            os.kill(os.getpid(), number)

    for number in SIGNALS:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
