"""``python -m hil_tests network``: a kernel's TCP and UDP against the model of the network."""

from __future__ import annotations

import argparse
import platform
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from bridge.network import parse_spec
from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from hil_tests.commands import end_children
from hil_tests.network.cells import KERNEL, TRANSPORTS, Cell, Drive, run_cell
from hil_tests.network.namespaces import why_not
from hil_tests.network.report import write_report

SPECS = {
    "perfect": "none",
    "clean": "25ms+-5ms",
    "loss1": "25ms+-5ms,loss=1%",
    "loss5": "25ms+-5ms,loss=5%",
    "bursts": "25ms+-5ms,loss=5%,burst=5",
}
ATTEMPTS = 3
POLICY = Path("results/policies/left_turn.onnx")
PUBLIC_KEY = Path("results/policies/policy.pub")

EXAMPLE = examples(
    "python -m hil_tests network --out runs/network.json --report runs",
    "python -m hil_tests network --transports tcp udp --episodes 4 --jobs 2",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="R.json", help="write the numbers to this file")
    parser.add_argument(
        "--report",
        metavar="DIR",
        help="write table.md and quantiles.png to this directory",
    )
    parser.add_argument("--policy", default=str(POLICY), help="policy file that drives")
    parser.add_argument("--public-key", default=str(PUBLIC_KEY), help="key of its signature")
    parser.add_argument("--episodes", type=positive, default=16, help="left turns in each cell")
    parser.add_argument("--seed", type=not_negative, default=0, help="of traffic and network")
    parser.add_argument(
        "--rows", nargs="+", choices=list(SPECS), default=list(SPECS), help="networks to compare"
    )
    parser.add_argument(
        "--transports", nargs="+", choices=list(TRANSPORTS), default=list(TRANSPORTS),
        help="ways through them",
    )  # fmt: skip
    parser.add_argument("--jobs", type=positive, default=1, help="cells that run at once")


def run(arguments: argparse.Namespace) -> int:
    """Run the cells, print the table, write the files.

    Raises:
        UserError: the machine has no kernel network.
    """
    with sigterm_as_interrupt():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    _check(arguments)
    cells = [
        Cell(row, transport, parse_spec(SPECS[row]))
        for row in arguments.rows
        for transport in arguments.transports
    ]
    found = _run_cells(arguments, cells)
    result = {
        "machine": {"kernel": platform.release(), "processor": platform.machine()},
        "scenario": "left_turn",
        "episodes": arguments.episodes,
        "seed": arguments.seed,
        "jobs": arguments.jobs,
        "rows": [{**_names(cell), **numbers} for cell, numbers in found],
    }
    write_json_out(arguments.out, result)
    if arguments.report is not None:
        write_report(result, Path(arguments.report))
    return 0


def _names(cell: Cell) -> dict[str, str]:
    return {"row": cell.row, "latency_spec": str(cell.spec), "transport": cell.transport}


def _check(arguments: argparse.Namespace) -> None:
    if set(arguments.transports) & set(KERNEL) and (reason := why_not()):
        raise UserError(f"no kernel network on this machine: {reason}")
    if arguments.out is not None:
        check_writable(arguments.out)
    load_policy(arguments.policy, arguments.public_key)
    if arguments.report is not None and not Path(arguments.report).is_dir():
        raise UserError(f"--report {arguments.report} is not a directory")


def _run_cells(
    arguments: argparse.Namespace, cells: list[Cell]
) -> list[tuple[Cell, dict[str, Any]]]:
    """In the order of ``cells``, some of them at once."""
    console, ending = Console(), threading.Event()
    with (
        tempfile.TemporaryDirectory() as folder,
        ThreadPoolExecutor(arguments.jobs) as pool,
        Progress(console=console, transient=True, disable=not console.is_terminal) as bar,
    ):
        drive = Drive(
            Path(arguments.policy), Path(arguments.public_key), arguments.episodes,
            arguments.seed, Path(folder),
        )  # fmt: skip
        futures = {pool.submit(_attempt, drive, cell, ending): cell for cell in cells}
        task = bar.add_task("cells", total=len(cells))
        try:
            for future in as_completed(futures):
                console.print(show(futures[future], future.result()), soft_wrap=True)
                bar.advance(task)
        except BaseException:
            ending.set()
            for future in futures:
                future.cancel()
            end_children()
            raise
        return [(cell, future.result()) for future, cell in futures.items()]


def _attempt(drive: Drive, cell: Cell, ending: threading.Event) -> dict[str, Any]:
    """A loop that never comes alive is a result, too: over UDP a lost declaration is for good."""
    failures: list[str] = []
    while len(failures) < ATTEMPTS and not ending.is_set():
        try:
            return {**run_cell(drive, cell), "failed_starts": failures}
        except UserError as error:
            failures.append(str(error))
    return {"failed_starts": failures}


def show(cell: Cell, found: dict[str, Any]) -> str:
    """A cell's result in a line."""
    if "round_trip_ms" not in found:
        return f"{cell.row:8} {cell.transport:10} never started: {found['failed_starts'][-1]}"
    times = found["round_trip_ms"]
    # None where no state was answered: a link that came up half dead.
    shown = "  ".join(
        f"{name} {'-' if times[name] is None else format(times[name], '.1f'):>6}"
        for name in ("p50", "p90", "p99")
    )
    return (
        f"{cell.row:8} {cell.transport:10} {shown} ms"
        f"  unanswered {found['unanswered_percent']:5.2f} %"
        f"  safe stops {found['safe_stops']}  success {found['success_rate']:.0%}"
        f"  failed starts {len(found['failed_starts'])}"
    )
