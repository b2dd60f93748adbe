"""What every part of the repository shares, with the standard library alone: the one error that a
user meets, text for a terminal, files to read, and signals that end a process.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shlex
import signal
import stat
import threading
from pathlib import Path
from typing import Any, BinaryIO, Callable, Dict, Iterable, Set, Union

PathLike = Union[str, "os.PathLike[str]"]
DEFAULT_PUBLIC_KEY = Path("keys/policy.pub")
"""Where `deploy keys` writes it, and whoever loads a policy looks for it."""
MAX_FILE_MIB = 64  # More than any certificate, configuration or report needs

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


def name_in_file(name: str, said: str, option: str) -> str:
    """A name that a file holds, of what is to be loaded: built in, or an installed entry point.

    `said` are the words before it, as in "F was trained in". No file decides what is imported:
    UserError for `module:thing`, which a person must type after `option`.
    """
    if ":" in name:
        rule = f"a module is imported only when it is typed: give {option} {shlex.quote(name)}"
        raise UserError(f"{said} {name}: {rule}")
    return name


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
    if "\0" in os.fspath(path):
        raise OSError(errno.EINVAL, "its name holds a NUL", str(path))
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "it is no regular file", str(path))


def read_bytes(path: PathLike, what: str, most_mib: int = MAX_FILE_MIB) -> bytes:
    """The bytes of an existing regular file. `what` names it in the error, as in "policy file".

    Raises UserError where it cannot be read, or holds more than `most_mib`.
    """
    limit = most_mib << 20
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
    if not is_small or len(data) > limit:
        raise UserError(f"{what} {path} is larger than {most_mib} MiB")
    return data


def read_json(path: PathLike, what: str) -> Dict[str, Any]:
    """The object in a JSON file. Raises UserError where there is none."""
    value = parse_json(read_bytes(path, what), f"{what} {path}")
    if not isinstance(value, dict):
        raise UserError(f"{what} {path} holds no JSON object")
    return value


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


def ends_within(limit_s: float, call: Callable[[], Any]) -> bool:
    """Call it in a thread that nobody need wait for; returns whether it came to its end in time."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(limit_s)
    return not thread.is_alive()


def ending_signals() -> Set[int]:
    """Those that would end this process as it is now, and that it can catch.

    One that is ignored (SIGHUP under nohup), or has a handler already, is none of them.
    """
    found = {int(number) for number in signal.valid_signals()} - {int(one) for one in _NOT_OURS}
    ends = (signal.SIG_DFL, signal.default_int_handler)
    return {number for number in found if signal.getsignal(number) in ends}


def take_signals(
    numbers: Iterable[int],
    handler: Union[Callable[[int, Any], Any], signal.Handlers],
    undo: contextlib.ExitStack,
) -> None:
    """Let `handler` have these signals until `undo` closes. Nothing outside of the main thread."""
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            undo.callback(signal.signal, number, signal.getsignal(number))
            signal.signal(number, handler)
