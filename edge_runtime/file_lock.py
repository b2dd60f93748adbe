"""Who writes a file holds the kernel's lock on it, which ends with the process, however it ends."""

from __future__ import annotations

import contextlib
import fcntl


def hold(descriptor: int) -> None:
    """Hold a file that was just made, until the descriptor is closed.

    Waits for one who looks at it in this moment. Without a word where the file system has no locks.
    """
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX)


def try_to_hold(descriptor: int) -> bool:
    """The same without waiting; False where another process holds the file."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # No locks here: then nobody can hold one.
        pass
    return True
