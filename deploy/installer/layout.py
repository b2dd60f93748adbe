"""Where things lie on the board, and how they change without ever being half changed.

ROOT/trusted.pub            the key that this board trusts; never taken from a bundle
ROOT/releases/VERSION/      whole releases only: made beside, named when all of it is on the disk
ROOT/current -> releases/V  what the service runs; changed by one rename
ROOT/previous -> releases/V where `rollback` goes
ROOT/.lock                  one installer at a time
ROOT/releases/.making-*     rubbish of a run that was cut off; the next run removes it
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import shutil
import time
from pathlib import Path
from typing import Iterator, TextIO

from deploy.installer.errors import UserError

DEFAULT_ROOT = "/opt/phil"
_MAKING = ".making-"
_LINKS = ("current", "previous")
_HOLD_LIMIT_S = 2.0
"""A runtime that asks whether it may send has the lock for microseconds."""


class Layout:
    """The folders under one root."""

    def __init__(self, root: str) -> None:
        self.root = Path(os.path.abspath(root))
        self.releases = self.root / "releases"
        self.trusted = self.root / "trusted.pub"
        self.state = self.root / "state"
        self.hold = self.state / "hold"

    def release(self, version: str) -> Path:
        """The folder of a release."""
        return self.releases / version

    def making(self, version: str) -> Path:
        """Where a release is made, or lies while it is taken away."""
        return self.releases / (_MAKING + version)

    def linked(self, name: str) -> str | None:
        """The version that `current` or `previous` names; None without one."""
        try:
            version = os.path.basename(os.readlink(str(self.root / name)))
        except OSError:
            return None
        return version if self.release(version).is_dir() else None

    def versions(self) -> list[str]:
        """All whole releases, by name."""
        if not self.releases.is_dir():
            return []
        return sorted(p.name for p in self.releases.iterdir() if not p.name.startswith("."))

    def link(self, name: str, version: str) -> None:
        """Let `current` or `previous` name a release, in one step."""
        draft = self.root / f".{name}"
        with contextlib.suppress(FileNotFoundError):
            draft.unlink()
        os.symlink(os.path.join("releases", version), str(draft))
        os.replace(str(draft), str(self.root / name))
        sync_folder(self.root)

    def unlink(self, name: str) -> None:
        """Let `current` or `previous` name nothing."""
        with contextlib.suppress(FileNotFoundError):
            (self.root / name).unlink()
        sync_folder(self.root)

    def remove_release(self, version: str) -> None:
        """Take a release away: first its name, so that no half of it ever bears it."""
        draft = self.making(version)
        remove_tree(draft)
        self.release(version).rename(draft)
        sync_folder(self.releases)
        remove_tree(draft)

    def tidy(self) -> None:
        """Remove what a run that was cut off has left."""
        for name in _LINKS:
            with contextlib.suppress(FileNotFoundError):
                (self.root / f".{name}").unlink()
        if self.releases.is_dir():
            for path in self.releases.glob(f"{_MAKING}*"):
                remove_tree(path)

    @contextlib.contextmanager
    def holding(self, gid: int | None = None) -> Iterator[None]:
        """Keep the service from sending any command (`hold` in its settings).

        A lock, not a file's existence: it ends with this process, whatever ends that. Whoever may
        read the file could lock it, too: only the service's group `gid` may. UserError where
        somebody does.
        """
        with self._open_lock(self.hold, gid) as stream:
            _lock_within(stream, _HOLD_LIMIT_S)
            yield

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Make the root and be the only installer in it. The lock goes with the process.

        It is `lockf`'s, which no child inherits: `flock`'s lives as long as any process that was
        forked with it, so a killed installer's compilers would keep it.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            stream = self._open_lock(self.root / ".lock")
        except OSError as error:
            raise UserError(f"cannot write to {self.root}: {error.strerror}") from None
        with stream:
            try:
                fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"another installer is at work in {self.root}") from None
            for folder in (self.releases, self.state):
                folder.mkdir(exist_ok=True)
            yield

    @staticmethod
    def _open_lock(path: Path, gid: int | None = None) -> TextIO:
        """Open a file to lock that nobody else can read, but for the group `gid`."""
        stream = open(str(path), "w")  # noqa: SIM115 - whoever locks it closes it
        os.fchmod(stream.fileno(), 0o600 if gid is None else 0o640)
        if gid is not None:
            os.fchown(stream.fileno(), -1, gid)
        return stream


def _lock_within(stream: TextIO, limit_s: float) -> None:
    end_s = time.monotonic() + limit_s
    while True:
        try:
            return fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > end_s:
                raise UserError(f"another process holds {stream.name} locked") from None
            time.sleep(0.02)


def write_whole(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file so that a power cut leaves the old one or the new one."""
    draft = path.with_name(f".{path.name}.new")
    with contextlib.suppress(FileNotFoundError):
        draft.unlink()
    with open(os.open(str(draft), os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(str(draft), str(path))
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(str(folder), os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_all(folder: Path) -> None:
    """Put everything on the folder's file system on the disk: one call for thousands of files."""
    descriptor = os.open(str(folder), os.O_RDONLY | os.O_DIRECTORY)
    try:
        if ctypes.CDLL(None, use_errno=True).syncfs(descriptor) != 0:
            raise OSError(ctypes.get_errno(), "syncfs failed")
    except AttributeError:  # a C library without it
        os.sync()
    finally:
        os.close(descriptor)


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, if it is there."""
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(str(path))
