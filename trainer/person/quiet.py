"""Libraries in C that speak to stderr themselves."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def quiet_stderr() -> Iterator[None]:
    """Drop what is written to stderr meanwhile, by any thread: keep it short.

    SDL and what it tries say more than one line where there is no screen; ours says it all.
    """
    sys.stderr.flush()
    try:
        kept = os.dup(STDERR)
    except OSError:  # It was closed, and nobody would read it.
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, STDERR)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
        os.close(nowhere)
