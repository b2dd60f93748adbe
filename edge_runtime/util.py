"""Shared by every part of the repository, with the standard library alone: UserError, text for a
terminal, and reading files.
"""

from __future__ import annotations

import errno
import json
import os
import shlex
import threading
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Callable, Dict, Union

PathLike = Union[str, "os.PathLike[str]"]
DEFAULT_PUBLIC_KEY = Path("keys/policy.pub")
"""Where `deploy keys` writes it, and where every reader of a policy looks for it."""
MAX_FILE_MIB = 64  # More than any certificate, configuration or report needs


class UserError(Exception):
    """Bad input. Its text is one line: what is wrong, and what would be right."""

    def __str__(self) -> str:
        # A file name or a library may have put anything into it.
        return printable(" ".join(super().__str__().split()))


def name_in_file(name: str, said: str, option: str) -> str:
    """Return a name that a file holds. UserError for `module:thing`, which a person must type."""
    if ":" in name:
        rule = f"a module is imported only when it is typed: give {option} {shlex.quote(name)}"
        raise UserError(f"{said} {name}: {rule}")
    return name


def counted(count: int, noun: str) -> str:
    """Count things whose plural is regular: "1 step", "2 steps"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def printable(text: str) -> str:
    """Write characters that a terminal would act upon as escapes, as `repr` does."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def open_regular(path: PathLike) -> BinaryIO:
    """Open an existing regular file to read; OSError for a pipe or a device without end."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return open(path, "rb")


def read_bytes(path: PathLike, what: str, most_mib: int = MAX_FILE_MIB) -> bytes:
    """Read a regular file, called `what` in the UserError, of at most `most_mib`."""
    try:
        with open_regular(path) as stream:
            data = stream.read((most_mib << 20) + 1)
    except FileNotFoundError:
        raise UserError(f"{what} {path} does not exist") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        why = getattr(error, "strerror", error)
        raise UserError(f"{what} {path} cannot be read: {why}") from None
    if len(data) > most_mib << 20:
        raise UserError(f"{what} {path} is larger than {most_mib} MiB")
    return data


def read_json(path: PathLike, what: str) -> Dict[str, Any]:
    return parse_json(read_bytes(path, what), f"{what} {path}")


def parse_json(data: bytes, what: str) -> Dict[str, Any]:
    """Parse the text of a JSON object. Raises UserError where it is none, or nested too deep."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{what} is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise UserError(f"{what} holds no JSON object")
    return value


def read_toml(path: PathLike, what: str) -> Dict[str, Any]:
    """Read the tables of a TOML file. Raises UserError where it is none, or nested too deep."""
    import msgspec  # here: the installer runs where nothing is installed

    try:
        return dict(msgspec.toml.decode(read_bytes(path, what)))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"{what} {path} is no TOML: {error}") from None


def load_named(place: str, what: str) -> Any:
    """Import `module:name`; UserError where that fails: a module may raise anything."""
    module, _, name = place.partition(":")
    try:
        return getattr(import_module(module), name)
    except (Exception, SystemExit) as error:
        raise UserError(f"no {what} {place!r}: {type(error).__name__}: {error}") from error


def ends_within(limit_s: float, call: Callable[[], Any]) -> bool:
    """Call in a thread of its own; return whether the call ended in time."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(limit_s)
    return not thread.is_alive()
