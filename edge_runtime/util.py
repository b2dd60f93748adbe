"""What every part of the repository shares, with the standard library alone: the one error that a
user meets, text for a terminal, files that are whole or absent, locks on files, and signals.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import signal
import stat
import tempfile
import threading
from pathlib import Path
from typing import Any, BinaryIO, Dict, Iterator, NoReturn, Set, Union

PathLike = Union[str, "os.PathLike[str]"]
MAX_FILE_MIB = 64
"""More than any policy, certificate, configuration or report needs."""

# Nobody can catch the first two. The processor raises the next four, and would raise them again
# before Python could act. The others do not end a process.
_NOT_OURS = (
    *(signal.SIGKILL, signal.SIGSTOP),
    *(signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL),
    *(signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH),
    *(signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
)


class UserError(Exception):
    """Bad input. Its text is one line: what is wrong, and what would be right."""

    def __str__(self) -> str:
        """The text on one line, whatever a file name or a library put into it."""
        return printable(" ".join(super().__str__().split()))


def counted(count: int, noun: str) -> str:
    """``count`` of what ``noun`` names, in its regular plural but for one: "1 step", "2 steps"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def printable(text: str) -> str:
    """The text, with what a terminal would act upon written as its escape, as ``repr`` does."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


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


def lock_file(descriptor: int) -> None:
    """Hold a file that was just made, until the descriptor is closed.

    Waits for one who looks at it in this moment. Without a word where the file system has no locks.
    """
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX)


def try_to_lock_file(descriptor: int) -> bool:
    """The same without waiting; False where another process holds the file."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # No locks here: then nobody can hold one.
        pass
    return True


def ending_signals() -> Set[int]:
    """Those that would end this process as it is now, and that it can catch.

    One that is ignored (SIGHUP under nohup), or has a handler already, is none of them.
    """
    found = {int(number) for number in signal.valid_signals()} - {int(one) for one in _NOT_OURS}
    ends = (signal.SIG_DFL, signal.default_int_handler)
    return {number for number in found if signal.getsignal(number) in ends}


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, and all else that would end this process, raise KeyboardInterrupt in the block.

    So sessions are closed and files are finished. Outside of the main thread it does nothing.
    """
    in_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ending_signals()} if in_main else {}
    for number in before:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt
