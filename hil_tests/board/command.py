"""``python -m hil_tests board``: a bundle onto boards that are not there, and what that took."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from bridge.signals import sigterm_as_interrupt
from deploy.wheels import DEFAULT_FOLDER
from edge_runtime.cli import ArgumentParser, examples, write_json_out
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable
from hil_tests.board import emulation
from hil_tests.board.proof import prove_emulated, prove_twin
from hil_tests.board.rootfs import DEFAULT_CACHE
from hil_tests.board.service import prove_booted, why_not_booted
from trainer.benches.machine import processor_model

BOARDS = ("aarch64", "python38", "systemd")
FIRST_COMMAND_LIMIT_S, INSTALL_LIMIT_S = 180.0, 20.0

EXAMPLE = examples("python -m hil_tests board --boards python38 --out runs/board.json")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--boards", nargs="+", choices=BOARDS, default=list(BOARDS),
        help="an emulated aarch64 root file system; the jetpack5 bundle's twin under Python 3.8;"
        " the same as a service of a real systemd",
    )  # fmt: skip
    parser.add_argument(
        "--cache", metavar="DIR", default=str(DEFAULT_CACHE), help="keeps debootstrap's work"
    )
    parser.add_argument(
        "--wheels", metavar="DIR", default=DEFAULT_FOLDER, help="keeps the bundles' wheels"
    )
    parser.add_argument("--out", metavar="R.json", help="write the reports to this file")


def run(arguments: argparse.Namespace) -> int:
    """Prove each board, print a line for each, write the file.

    Raises:
        UserError: this machine cannot, or a step failed.
    """
    if arguments.out is not None:
        check_writable(arguments.out)
    for board in arguments.boards:
        if reason := why_not(board):
            raise UserError(f"no {board} here: {reason}")
    report: dict[str, Any] = {"machine": {"processor": processor_model(), "cores": os.cpu_count()}}
    with sigterm_as_interrupt():
        for board in arguments.boards:
            report[board] = prove(board, Path(arguments.cache), Path(arguments.wheels))
            print(line(board, report[board]), flush=True)
    write_json_out(arguments.out, report)
    return 0


def prove(board: str, cache: Path, wheels: Path) -> dict[str, Any]:
    """The report of one of BOARDS, with its bar."""
    if board == "aarch64":
        report = prove_emulated(cache, wheels)
        name, limit_s = "root_to_first_command_s", FIRST_COMMAND_LIMIT_S
    else:
        python = str(find_python38())
        name, limit_s = "installed_s", INSTALL_LIMIT_S
        booted = board == "systemd"
        report = prove_booted(python, cache, wheels) if booted else prove_twin(python, wheels)
    return {**report, "bar": {"of": name, "limit_s": limit_s, "met": report[name] < limit_s}}


def why_not(board: str) -> str:
    """What is missing for one of BOARDS here; empty if nothing is."""
    if board == "aarch64":
        return emulation.why_not()
    if os.geteuid() != 0:
        return "a network of its own needs root"
    python = find_python38()
    if python is None:
        return "no Python 3.8 on PATH or under ~/.pyenv"
    return why_not_booted(python) if board == "systemd" else ""


def find_python38() -> str | None:
    """A Python 3.8 of this machine; None without one."""
    candidates = [shutil.which("python3.8")]
    candidates += [str(p) for p in sorted(Path.home().glob(".pyenv/versions/3.8*/bin/python"))]
    for candidate in filter(None, candidates):
        asked = subprocess.run(
            [candidate, "-c", "import json, sys; print(json.dumps(sys.version_info[:2]))"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if asked.returncode == 0 and json.loads(asked.stdout) == [3, 8]:
            return candidate
    return None


def line(board: str, report: dict[str, Any]) -> str:
    """What a person wants to know of one board."""
    bar = report["bar"]
    return (
        f"{board:9} Python {report['python']} on {report['machine']}:"
        f" bundle {report['bundle_mb']:.1f} MB, installed in {report['installed_s']:.1f} s,"
        f" first command after {report['root_to_first_command_s']:.1f} s,"
        f" success {report['episode']['success_rate']:.0%};"
        f" {bar['of']} under {bar['limit_s']:.0f} s: {'met' if bar['met'] else 'NOT met'}"
    )
