"""Signals that would end this process: each of them is a request to end in order."""

from __future__ import annotations

import contextlib
import signal
import threading
from typing import Any, Iterator, NoReturn, Set

# Nobody can catch the first two. The processor raises the next four, and would raise them again
# before Python could act. The others do not end a process.
_NOT_OURS = (
    *(signal.SIGKILL, signal.SIGSTOP),
    *(signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL),
    *(signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH),
    *(signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
)


def ending_signals() -> Set[int]:
    """Those that would end this process as it is now, and that it can catch.

    One that is ignored (SIGHUP under nohup), or has a handler already, is none of them.
    """
    found = {int(number) for number in signal.valid_signals()} - {int(one) for one in _NOT_OURS}
    ends = (signal.SIG_DFL, signal.default_int_handler)
    return {number for number in found if signal.getsignal(number) in ends}


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, and all else that would end this process, raise KeyboardInterrupt in the block.

    So sessions are closed and files are finished. Outside of the main thread it does nothing.
    """
    in_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ending_signals()} if in_main else {}
    for number in before:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt
