"""Python's state for a thread that Python did not start."""

from __future__ import annotations

import ctypes
import threading

_thread = threading.local()


def keep_state() -> None:
    """Let this thread keep its Python state until it ends.

    A native thread that calls into Python is given a new state by PyGILState_Ensure, and it is
    taken down when the call returns: tens of microseconds of each call. One Ensure that is never
    released keeps it. These threads live as long as the session, so nothing piles up.
    """
    if not getattr(_thread, "kept", False):
        ctypes.pythonapi.PyGILState_Ensure()
        _thread.kept = True
