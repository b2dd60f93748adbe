"""What a check is, and what becomes of it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

INSTALL = "make install"
TIMEOUT_S = 60.0
"""For a program that a probe starts."""


class MissingError(Exception):
    """The machine has it not; the text says what was tried and what came of it."""


class Check(NamedTuple):
    """One thing that a machine may have."""

    name: str
    probe: Callable[[], str]
    """Does it, and says in a few words what it found; any exception says that it is missing."""
    without: str
    """What there is where it is missing, or is not."""
    remedy: str
    """How to get it."""
    basic: bool = False
    """Whether nothing much works without it."""


@dataclass(frozen=True)
class Finding:
    """A check that was made."""

    group: str
    name: str
    ok: bool
    detail: str
    basic: bool
    without: str
    remedy: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def examine(group: str, check: Check) -> Finding:
    """Make a check; whatever goes wrong in it is its finding."""
    remedy = check.remedy
    try:
        ok, detail = True, check.probe()
    # Whatever it is that was to be tried: it was not come to.
    except ModuleNotFoundError as error:
        ok, detail, remedy = False, f"Python finds no module {error.name}", INSTALL
    except MissingError as error:
        ok, detail = False, str(error)
    # A broken library may raise anything at all, and the checks after it are still wanted.
    except Exception as error:
        ok, detail = False, f"{type(error).__name__}: {error}"
    text = " ".join(detail.split())
    return Finding(group, check.name, ok, text, check.basic, check.without, remedy)


def output_of_python(script: str) -> str:
    """What a script prints, in a process of its own.

    Raises:
        ModuleNotFoundError: it imports what is not installed.
        MissingError: it fails in another way.
    """
    try:
        return output_of(sys.executable, "-c", script)
    except MissingError as error:
        absent = re.search(r"ModuleNotFoundError: No module named '([\w.]+)'", str(error))
        if absent is None:
            raise
        raise ModuleNotFoundError(name=absent[1]) from None


def output_of(*command: str, name: str = "") -> str:
    """What a program prints; ``name`` is for the error, the program's own if not given.

    Raises:
        MissingError: it is not there, fails, or does not end.
    """
    name = name or command[0].rpartition("/")[2]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except FileNotFoundError:
        raise MissingError(f"{name} is not installed") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise MissingError(f"{name}: {error}") from None
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise MissingError(f"{name}: {(lines or [f'exit status {done.returncode}'])[-1]}")
    return done.stdout.strip()
