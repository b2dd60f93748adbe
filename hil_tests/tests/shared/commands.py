"""Commands in this process, and how they refuse."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_runtime.cli import run_cli


def exit_status(main: Callable[[list[str]], int], arguments: list[str]) -> int:
    """Return the status with which a command ends, also where argparse ends it."""
    try:
        return run_cli(main, arguments)
    except SystemExit as end:
        return int(end.code or 0)


def call(capsys: Any, *arguments: object, package: str = "trainer") -> tuple[int, str, str]:
    """Run ``python -m PACKAGE`` in this process; return exit status, stdout and stderr."""
    main = importlib.import_module(f"{package}.__main__").main
    status = exit_status(main, [str(argument) for argument in arguments])
    return status, *capsys.readouterr()


def refusal(capsys: Any, *arguments: object, package: str = "trainer") -> str:
    """Return the one line with which a command ends that is given bad input."""
    status, out, err = call(capsys, *arguments, package=package)
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1), err
    return err


def run_command(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``python -m edge_runtime`` in a process of its own to its end."""
    command = [sys.executable, "-m", "edge_runtime", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=cwd, check=False)
