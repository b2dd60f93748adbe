"""Files that are either whole or absent, never half-written, and locked by their writer.

The lock is the kernel's: it ends with the process, however that ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import shutil
from pathlib import Path
from typing import Any, Iterator, Optional

from edge_runtime.util import PathLike, UserError


def write_atomic(path: PathLike, data: bytes | memoryview) -> None:
    """Write `data` so that a reader or a crash sees the old file or the new one, nothing between.

    Missing directories are made; a symbolic link is replaced. UserError for what is no regular
    file.
    """
    target = _checked(path)
    make_directory(target.parent)
    temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def check_writable(path: Optional[PathLike]) -> Optional[PathLike]:
    """Return the absolute path; UserError now if `write_json_out(path)` would fail later."""
    if path is None:
        return None
    target = _checked(path)
    directory = next(place for place in target.absolute().parents if os.path.exists(place))
    if not directory.is_dir() or not os.access(str(directory), os.W_OK | os.X_OK):
        raise UserError(f"cannot write {target}: Not a directory to write in: {directory}")
    return os.path.abspath(path)


@contextlib.contextmanager
def draft_of(target: Path) -> Iterator[Path]:
    """Yield a hidden place: what is made there gets the name `target`, unless an error comes."""
    make_directory(target.parent)
    draft = target.with_name(f".{target.name}.{os.getpid()}{target.suffix}")
    try:
        yield draft
        os.replace(draft, target)
    finally:
        if draft.is_dir():
            shutil.rmtree(draft, ignore_errors=True)
        else:
            draft.unlink(missing_ok=True)


def make_directory(path: PathLike) -> None:
    """Make a directory and those above it where they are missing; UserError where that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create the directory {path}: {error.strerror}") from None


def write_json(path: PathLike, value: Any) -> None:
    """`write_atomic` of indented JSON; ValueError for NaN and infinity, which are not JSON."""
    write_atomic(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def write_json_out(path: Optional[PathLike], value: Any) -> None:
    """Write a command's result to its `--out` file, if it has one."""
    if path is not None:
        write_json(path, value)


def _checked(path: PathLike) -> Path:
    """Return the file to replace; UserError for a directory, a device or a pipe."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise UserError(f"cannot write {path}: it is no regular file")
    return Path(path)


def try_to_lock_file(descriptor: int) -> bool:
    """Lock a file until the descriptor is closed; False where another process holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
