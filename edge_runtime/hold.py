"""No command while an installer tries this release: neither on the wire nor to the vehicle.

The installer holds a lock on a file for as long as it judges. The lock ends with its process, so
an installer that dies leaves nobody silent. Once free, this process never asks again.
"""

from __future__ import annotations

import fcntl
from typing import BinaryIO, Optional

from edge_runtime.errors import UserError
from edge_runtime.files import open_regular


class Hold:
    """`path` is the file; None, or one that is not there, holds nothing.

    Raises UserError for one that cannot be read: nobody could say whether it holds.
    """

    def __init__(self, path: Optional[str] = None) -> None:
        self._stream: Optional[BinaryIO] = None
        if path is not None:
            try:
                self._stream = open_regular(path)  # kept until it is free
            except FileNotFoundError:
                return
            except OSError as error:
                raise UserError(f"hold {path} cannot be read: {error.strerror}") from None

    def is_on(self) -> bool:
        """Whether commands must stay here. Never waits."""
        if self._stream is None:
            return False
        try:
            fcntl.flock(self._stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        self._stream.close()
        self._stream = None
        return False

    def refusal(self) -> str:
        """Why nobody may re-arm now; empty when free."""
        return "an installer tries this release; re-arm when it is done" if self.is_on() else ""
