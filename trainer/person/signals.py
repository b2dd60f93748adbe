"""^C and SIGTERM end a sitting as quitting does: with everything kept."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from trainer.person.sitting import Sitting

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def quit_on_signals(sitting: Sitting) -> Iterator[None]:
    """Let the first signal ask the sitting to stop.

    A second one, or one when it is over, ends the process as ever.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def stop(number: int, frame: Any) -> None:
        for name, handler in before.items():
            signal.signal(name, handler)
        if sitting.closed:
            os.kill(os.getpid(), number)
        sitting.stop = True

    for number in SIGNALS:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
