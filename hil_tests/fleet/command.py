"""``python -m hil_tests fleet``: what a router bears, and what many more vehicles would take."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bridge.signals import sigterm_as_interrupt
from edge_runtime.cli import ArgumentParser, examples, write_json_out
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable
from edge_runtime.option_types import positive
from edge_runtime.words import counted
from hil_tests.fleet.drive import measure
from hil_tests.fleet.rules import certificates_ms, measure_rules
from hil_tests.fleet.scale import per_vehicle, project
from hil_tests.fleet.usage import why_not_counted
from trainer.util import processor_model

_SIZES = (1, 5, 10, 20)
_RULES = (10, 100, 1_000)
_CERTIFIED = 100
_TRIES = 3
_UNDISTURBED = 0.9
"""Each vehicle has an answer to this share of its states at least; else the machine was busy."""

EXAMPLE = examples("python -m hil_tests fleet --vehicles 1 5 --seconds 10 --out runs/fleet.json")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--vehicles", metavar="N", nargs="+", type=positive, default=list(_SIZES),
        help="sizes of the fleets, at least two",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", metavar="S", type=positive, default=30, help="of each measurement, seconds"
    )
    parser.add_argument(
        "--rules", metavar="N", nargs="+", type=positive, default=list(_RULES),
        help="vehicles with rights in a router's file that nobody connects to",
    )  # fmt: skip
    parser.add_argument("--out", metavar="R.json", help="write the numbers to this file")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the tables, write the file.

    Raises:
        UserError: nothing to draw a slope through, no means to count bytes, or a fleet that does
            not drive.
    """
    if arguments.out is not None:
        check_writable(arguments.out)
    if len(set(arguments.vehicles)) < 2:
        raise UserError("--vehicles needs two sizes or more: what a vehicle adds is a slope")
    if why_not_counted():
        raise UserError(f"bytes cannot be counted: {why_not_counted()}")
    console = Console()
    try:
        with sigterm_as_interrupt():
            report = _measure(arguments, console)
    except TimeoutError as error:
        raise UserError(f"the fleet did not drive: {error}") from None
    write_json_out(arguments.out, report)
    _show(report, console)
    return 0


def _measure(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    rows = []
    for count in sorted(set(arguments.vehicles)):
        rows.append(_undisturbed(count, arguments.seconds))
        console.print(f"{counted(count, 'vehicle')}: done, {rows[-1]['tries']} tries")
    with tempfile.TemporaryDirectory() as folder:
        rules = measure_rules(sorted(set(arguments.rules)), Path(folder))
        making_ms = certificates_ms(_CERTIFIED, Path(folder) / "many")
    each = per_vehicle(rows)
    return {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "fleets": rows,
        "rules": rules,
        "certificates_ms_a_vehicle": making_ms,
        "per_vehicle": each,
        "projected": project(each, rules),
    }


def _undisturbed(count: int, seconds: int) -> dict[str, Any]:
    """A fleet's report; where the machine had no time for it, that of the best of three tries."""
    tries: list[dict[str, Any]] = []
    while len(tries) < _TRIES and not (tries and tries[-1]["answered_least"] >= _UNDISTURBED):
        with tempfile.TemporaryDirectory() as folder:
            tries.append(measure(count, seconds, Path(folder)))
    return {**max(tries, key=lambda row: float(row["answered_least"])), "tries": len(tries)}


def _show(report: dict[str, Any], console: Console) -> None:
    for name in ("fleets", "rules", "projected"):
        rows = [{key: _text(value) for key, value in row.items()} for row in report[name]]
        table = Table(title=name, title_justify="left")
        table.add_column("")
        for row in rows:
            table.add_column(row["vehicles"], justify="right")
        for key in list(rows[0])[1:]:
            table.add_row(key.replace("_", " "), *(row[key] for row in rows))
        console.print(table)


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{key} {_text(each)}" for key, each in value.items())
    return f"{value:,.3g}" if isinstance(value, float) else f"{value:,}"
