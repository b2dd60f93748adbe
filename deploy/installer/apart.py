"""Keeps a child process apart: no network, another user, and an end with its parent.

By the C library, between fork and exec: `unshare` and `setpriv` are not on every board.
"""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Callable, NamedTuple

_C = ctypes.CDLL(None, use_errno=True)
_NEW_USER, _NEW_NET = 0x10000000, 0x40000000  # sched.h
_SET_PARENT_DEATH_SIGNAL = 1  # sys/prctl.h


class Account(NamedTuple):
    """The user and group that the service runs as."""

    uid: int
    gid: int


def can_isolate() -> bool:
    """Whether the kernel lets us take a child's network away."""
    pid = os.fork()
    if pid == 0:
        os._exit(0 if _isolate() else 1)
    return os.waitpid(pid, 0)[1] == 0


def before_exec(isolated: bool, account: Account | None) -> Callable[[], None]:
    """What a child does before it becomes the runtime (`preexec_fn`)."""
    parent = os.getpid()

    def prepare() -> None:
        if isolated and not _isolate():
            os._exit(1)
        if account is not None:
            os.setgroups([])
            os.setgid(account.gid)
            os.setuid(account.uid)
        end_with_parent(parent)  # Last: another user id would undo it.

    return prepare


def end_with_parent(parent: int) -> None:
    """Let the kernel kill this process when its parent, of that process id, has ended."""
    _C.prctl(_SET_PARENT_DEATH_SIGNAL, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:  # It had ended before it was asked for.
        os._exit(1)


def _isolate() -> bool:
    """A network namespace of its own: not even loopback is up in it."""
    flags = _NEW_NET if os.geteuid() == 0 else _NEW_USER | _NEW_NET
    return bool(_C.unshare(flags) == 0)
