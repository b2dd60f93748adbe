"""A file that grows by whole blocks: what has been flushed stays whole on a full disk, too."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from edge_runtime.files import check_writable, lock_file, make_directory
from edge_runtime.util import UserError

MAX_PENDING_BYTES = 4 << 20
NEVER_OVER = "choose another name: no recording is lost"


def check_new(path: Path) -> None:
    """Raise UserError now if a recording could not be begun there later."""
    check_writable(path)
    if path.exists():
        raise UserError(f"{path} exists; {NEVER_OVER}")


class FlushedFile:
    """Collects bytes and writes them out on ``flush``; where that fails, it cuts off the torn part.

    It holds the file's lock until it is closed: ``bridge repair`` keeps away meanwhile. Made for
    ``mcap.writer.Writer``, which needs ``write``, ``tell`` and ``flush``.
    """

    def __init__(self, path: Path) -> None:
        """Raise UserError where the file exists already, or cannot be made."""
        make_directory(path.parent)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        try:
            self._descriptor = os.open(path, flags, 0o666)
        except FileExistsError:
            raise UserError(f"{path} exists; {NEVER_OVER}") from None
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}") from None
        lock_file(self._descriptor)
        self.flushed_bytes = 0
        self._pending = bytearray()

    def write(self, data: bytes) -> int:
        """Keep the bytes for the next flush, which comes by itself when they are many."""
        self._pending += data
        if len(self._pending) > MAX_PENDING_BYTES:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Return the length of the file, what is still to be flushed included."""
        return self.flushed_bytes + len(self._pending)

    def flush(self) -> None:
        """Hand everything to the operating system, which keeps it when this process is killed.

        Raises OSError (a full disk, for one); the file is then as it was after the last flush.
        """
        view = memoryview(bytes(self._pending))
        self._pending.clear()
        written = 0
        try:
            while written < len(view):
                written += os.write(self._descriptor, view[written:])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.flushed_bytes)
                os.lseek(self._descriptor, self.flushed_bytes, os.SEEK_SET)
            raise
        self.flushed_bytes += written

    def close(self) -> None:
        """Close the file without a last flush."""
        os.close(self._descriptor)
