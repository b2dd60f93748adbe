"""Files that are either whole or absent, never half-written."""

from __future__ import annotations

import errno
import json
import os
import stat
import tempfile
from pathlib import Path
from typing import Any, BinaryIO, Dict, Union

from edge_runtime.errors import UserError

PathLike = Union[str, "os.PathLike[str]"]


MAX_FILE_MIB = 64
"""More than any policy, certificate, configuration or report needs."""


def open_regular(path: PathLike) -> BinaryIO:
    """Open an existing file to read; OSError where it cannot be, or is no regular file.

    A pipe would be waited for, and a device may have no end.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "it is no regular file", str(path))


def read_bytes(path: PathLike, what: str) -> bytes:
    """The bytes of an existing regular file. `what` names it in the error, as in "policy file".

    Raises UserError where it cannot be read, or holds more than MAX_FILE_MIB.
    """
    limit = MAX_FILE_MIB << 20
    try:
        with open_regular(path) as stream:
            # The size first; and no more than that, for a file of /proc has none.
            is_small = os.fstat(stream.fileno()).st_size <= limit
            data = stream.read(limit + 1) if is_small else b""
    except FileNotFoundError:
        raise UserError(f"{what} {path} does not exist") from None
    except IsADirectoryError:
        raise UserError(f"{what} {path} is a directory, not a file") from None
    except OSError as error:
        raise UserError(f"{what} {path} cannot be read: {error.strerror}") from None
    except ValueError as error:  # a NUL inside the name
        raise UserError(f"{what} {path!r} is not a file name: {error}") from None
    if not is_small or len(data) > limit:
        raise UserError(f"{what} {path} is larger than {MAX_FILE_MIB} MiB")
    return data


def read_json(path: PathLike, what: str) -> Any:
    """The value in a JSON file. Raises UserError where there is none."""
    return parse_json(read_bytes(path, what), f"{what} {path}")


def parse_json(data: bytes, what: str) -> Any:
    """The value of a JSON text. Raises UserError where it is none, or nested too deep."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{what} is not JSON: {error}") from None


def read_toml(path: PathLike, what: str) -> Dict[str, Any]:
    """The tables of a TOML file. Raises UserError where it is none, or nested too deep."""
    import msgspec  # here: `hil_tests doctor` runs before anything is installed

    data = read_bytes(path, what)
    try:
        tables: Dict[str, Any] = msgspec.toml.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"{what} {path} is no TOML: {error}") from None
    return tables


def write_atomic(path: PathLike, data: bytes | memoryview) -> None:
    """Write `data` so that a reader or a crash sees the old file or the new one, nothing between.

    A symbolic link stays, and the file behind it is written. Its directory is made. Raises
    UserError when that cannot be made or written, and for a path that is there and is no regular
    file.
    """
    target = _checked(path)
    make_directory(target.parent)
    try:
        descriptor, temporary = tempfile.mkstemp(dir=str(target.parent), prefix=f".{target.name}.")
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp gives 0600, open() would not
        os.replace(temporary, target)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError):
            raise UserError(f"cannot write {target}: {error.strerror}") from None
        raise


def behind_link(path: PathLike) -> Path:
    """The file that a symbolic link leads to, there or not; any other path as it is."""
    return Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)


def check_writable(path: PathLike) -> None:
    """Raise UserError now if `write_atomic(path)` would fail later, after the long work.

    It makes nothing: whatever else is wrong with the command leaves no empty directory behind.
    """
    target = _checked(path)
    directory = next(place for place in target.absolute().parents if os.path.exists(place))
    if not directory.is_dir():
        raise UserError(f"cannot write {target}: {directory} is no directory")
    if not os.access(str(directory), os.W_OK | os.X_OK):
        raise UserError(f"cannot write {target}: the directory {directory} is read-only")


def make_directory(path: PathLike) -> None:
    """Make a directory, and those above it, where it is not there; UserError where it cannot be."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create the directory {path}: {error.strerror}") from None


def write_json(path: PathLike, value: Any) -> None:
    """`write_atomic` of indented JSON. NaN and infinity are refused (they are not JSON)."""
    write_atomic(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def _checked(path: PathLike) -> Path:
    """What to replace. A rename would put a plain file in the place of a device or a pipe."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        target = behind_link(path)
        if os.path.islink(path) and not target.parent.is_dir():  # a disk that is not there?
            raise UserError(
                f"cannot write {path}: it leads to {target.parent}, which does not exist"
            ) from None
        return target
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from None
    except ValueError as error:  # a NUL inside the name
        raise UserError(f"cannot write {path!r}: {error}") from None
    if stat.S_ISDIR(mode):
        raise UserError(f"{path} is a directory, not a file")
    if not stat.S_ISREG(mode):
        raise UserError(f"cannot write {path}: it is no regular file")
    return behind_link(path)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
