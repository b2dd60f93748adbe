"""One process at a time: a kernel lock on a file that names its holder."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from edge_runtime.files import make_directory
from edge_runtime.util import UserError

LOCK_FILE = ".lock"
"""In a directory that is claimed, for as long as it is."""


@contextmanager
def claimed(directory: Path) -> Iterator[None]:
    """Be the only process that trains in a directory.

    It is made where it is not there, and goes again if nothing has come into it.

    Raises:
        UserError: another process trains there, or the directory cannot be made or written.
    """
    made = [path for path in (directory, *directory.parents) if not os.path.lexists(path)]
    make_directory(directory)
    try:
        with held(directory / LOCK_FILE) as mine:
            if not mine:
                who = holder(directory / LOCK_FILE)
                raise UserError(f"{directory} is being trained in by {who}")
            yield
    finally:
        with suppress(OSError):  # It holds something.
            for path in made:
                path.rmdir()


@contextmanager
def held(path: Path, patience_s: float = 0.0) -> Iterator[bool]:
    """Hold a lock against other processes; gives whether that was possible within so many seconds.

    The lock is the kernel's: when a process dies, however it dies, its lock is gone with it, and
    the file that it leaves behind keeps nobody out. Its directory must be there.

    Raises:
        UserError: the file cannot be written or locked.
    """
    try:
        descriptor = _locked(path, time.monotonic() + patience_s)
    except OSError as error:
        raise UserError(f"cannot lock {path}: {error.strerror}") from None
    if descriptor is None:
        yield False
        return
    try:
        yield True
    finally:
        if _is(path, descriptor):
            path.unlink()
        os.close(descriptor)


def holder(path: Path) -> str:
    """Who holds a lock, in words."""
    try:
        who = json.loads(path.read_bytes())
        return f"process {who['pid']} on {who['host']}"
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return "another process"


def _locked(path: Path, end_s: float) -> int | None:
    """The locked file, opened and with this process's name in it; None where another has it."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Whoever lets go removes the file. A lock on one without a name keeps nobody out.
            if _is(path, descriptor):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(_me()).encode(), 0)
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            if time.monotonic() >= end_s:
                return None
            time.sleep(0.01)
            continue
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is(path: Path, descriptor: int) -> bool:
    """Whether the open file is the one that has the name."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _me() -> dict[str, object]:
    return {"pid": os.getpid(), "host": socket.gethostname()}
