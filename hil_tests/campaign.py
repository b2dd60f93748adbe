"""``python -m hil_tests campaign``: every fault, every network of the axes, one report.

The unit of work is a chunk: some episodes of one network through a real edge runtime, in virtual
time, kept on disk. Each worker has an edge runtime process and an endpoint of its own.
"""

from __future__ import annotations

import argparse
import queue
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.cli import ArgumentParser, examples, positive, sigterm_as_interrupt
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError, read_json
from hil_tests.faults.run import choose_rows, run_faults
from hil_tests.processes import BackgroundCommand, CommandTimeoutError, in_parallel, trusting
from hil_tests.report import (
    check_report,
    render_faults,
    render_latency,
    write_figures,
    write_report,
)
from hil_tests.sweep import (
    NETWORK_AXES,
    Axis,
    KeptResults,
    Task,
    add_sweep_arguments,
    budget,
    make_row,
    simulate,
    task_of,
    this_command,
    turns,
    worth_keeping,
)
from trainer.evaluate import cores
from trainer.util import ProgressBar

PARTS = ("latency", "faults")
VEHICLE_ID = "campaign01"
CHUNK_EPISODES = 50
CHUNK_LIMIT_S = 900.0
ATTEMPTS = 6
FORMAT = 2
"""Raise it where the same specification begins to mean another drive: kept chunks become void."""
SHOWN_WRONG = 5
EXAMPLE = examples(
    "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
    "python -m hil_tests campaign --only faults --rows 'hunter_*' --tries 100 --out runs/f.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_sweep_arguments(parser, PARTS, 100, "episodes of each row, the same seeds", 0.98)
    parser.add_argument(
        "--rows",
        metavar="NAME,...",
        help=f"only these latency axes ({', '.join(axis.name for axis in NETWORK_AXES)}) and "
        "faults, by name or pattern (hunter_*)",
    )
    parser.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="NAME=R.json",
        help="show another campaign's curves and budget beside",
    )
    parser.add_argument("--tries", type=positive, default=10, help="of each fault")


def run(arguments: argparse.Namespace) -> int:
    """Run the parts; 0, or 1 where a fault was not met as it should be."""
    out = Path(arguments.out)
    check_report(out)
    arguments.jobs = arguments.jobs or cores()
    axes, faults = _choose(arguments)
    others = dict(_other(text) for text in arguments.against)
    report: dict[str, Any] = {"command": this_command()}
    name = Path(arguments.policy or f"{arguments.scenario}.onnx").name
    text = [f"# Campaign: {name}, {arguments.scenario}", "", f"`{this_command()}`", ""]
    if axes:
        with sigterm_as_interrupt():  # Whoever ends a campaign ends its processes.
            latency = _run_latency(arguments, axes, out.with_name(f"{out.stem}_rows"))
        figures = write_figures(out, latency, others)
        report["latency"] = {**latency, "figures": figures}
        text += ["## Latency", "", render_latency(latency, figures, others)]
    if faults is not None:
        report["faults"] = _run_faults(arguments, faults)
        text += ["## Faults", "", render_faults(report["faults"])]
    write_report(out, report, text)
    _conclude(out, report)
    return 0 if faults is None or report["faults"]["passed"] else 1


def _choose(arguments: argparse.Namespace) -> tuple[list[Axis], list[str] | None]:
    """The latency axes, and the faults by name ([]: all of them; None: no faults)."""
    known = {axis.name: axis for axis in NETWORK_AXES}
    named = arguments.rows.split(",") if arguments.rows else []
    axes = [known[name] for name in named if name in known] if named else list(known.values())
    faults = [name for name in named if name not in known]
    if faults and arguments.only == "latency":
        raise UserError(f"no latency axis {faults[0]!r}; choose from {', '.join(known)}")
    if arguments.only == "faults":
        if named and not faults:
            raise UserError(f"{arguments.rows} names latency axes, no fault")
        axes = []
    choose_rows(faults)  # now, not after the hours of the latency rows
    without_faults = arguments.only == "latency" or (named and not faults)
    return axes, None if without_faults else faults


def _run_faults(arguments: argparse.Namespace, names: list[str]) -> dict[str, Any]:
    policy = Path(arguments.policy) if arguments.policy else None
    with ProgressBar("faults", arguments.tries * len(choose_rows(names or None))) as bar:
        return run_faults(
            arguments.tries, names or None, policy, lambda row: bar.advance({"row": row}),
            arguments.jobs, arguments.public_key,
        )  # fmt: skip


def _other(text: str) -> tuple[str, dict[str, Any]]:
    name, equals, path = text.partition("=")
    if not equals:
        raise UserError(f"--against {text}: write NAME=R.json")
    try:
        latency: dict[str, Any] = read_json(path, "report")["latency"]
        budget_part = latency["budget"]
        sentence = budget_part["sentence"].removeprefix(Path(latency["policy"]).stem)
        budget_part["sentence"] = name + sentence
        latency["rows"]
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path} is no report of a latency campaign with its budget") from None
    return name, latency


def _conclude(out: Path, report: dict[str, Any]) -> None:
    if "latency" in report:
        print(report["latency"]["budget"]["sentence"])
    if faults := report.get("faults"):
        for row in faults["rows"]:
            for kind in ("wrong", "unsafe", "crashes"):
                for what in row[kind][:SHOWN_WRONG]:
                    print(f"{row['name']}: {kind}: {what}")
        print("Every fault was met." if faults["passed"] else "Not every fault was met.")
    print(f"{out} and {out.with_suffix('.md')}")


class Chunk(NamedTuple):
    """Episodes with the seeds ``first_seed``, ``first_seed + 1``, ...: the same for every row."""

    spec: str
    first_seed: int
    episodes: int


def _run_latency(arguments: argparse.Namespace, axes: Sequence[Axis], keep: Path) -> dict[str, Any]:
    """Sweep the axes; the part ``latency`` of the report. What is kept is not driven again."""
    task = task_of(arguments)
    deciding = {"format": FORMAT, "policy": task.policy_id, "clock": "lockstep"}
    store = KeptResults(keep, task, deciding)
    every_turn = turns(task.seed, task.runs, CHUNK_EPISODES)
    specs = dict.fromkeys(spec for axis in axes for spec in axis.specs)
    chunks = {spec: [Chunk(spec, *turn) for turn in every_turn] for spec in specs}
    found = store.complete(
        "latency",
        [chunk for some in chunks.values() for chunk in some],
        Chunk._asdict,
        lambda missing, on_done: drive_chunks(task, missing, arguments.jobs, on_done),
        lambda chunk, _: {"of": chunk.spec},
    )
    rows = {
        spec: make_row(spec, [part for chunk in some for part in found[chunk]["parts"]])
        for spec, some in chunks.items()
    }
    driven_s, wall_s = (sum(row[name] for row in rows.values()) for name in ("driven_s", "wall_s"))
    return {
        **task.facts(),
        "clock": "lockstep",
        "axes": [axis.as_dict() for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, arguments.target, task.policy.stem),
        "faster_than_real_time": driven_s / wall_s,
    }


def drive_chunks(
    task: Task,
    chunks: Sequence[Chunk],
    jobs: int,
    on_chunk: Callable[[Chunk, dict[str, Any]], None],
) -> None:
    """Drive all chunks, ``jobs`` at a time.

    Raises:
        UserError: a command failed, or the machine stood still again and again.
    """
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()

    def work(chunk: Chunk) -> dict[str, Any]:
        worker = idle.get()
        try:
            return worker.drive(chunk)
        finally:
            idle.put(worker)

    with ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="phil-campaign-"))
        for number in range(min(jobs, len(chunks))):
            worker = Worker(task, Path(directory) / f"{number}.json")
            stack.callback(worker.close)
            idle.put(worker)
        in_parallel(work, chunks, jobs, on_chunk)


class Worker:
    """One edge runtime that stays, and one simulator after another."""

    def __init__(self, task: Task, out: Path) -> None:
        self._task, self._out = task, out
        self.start_edge()

    def start_edge(self) -> None:
        """Start the edge runtime, on an endpoint of its own."""
        task = self._task
        self._endpoint = free_endpoint()
        self.edge = BackgroundCommand(
            "edge_runtime", "run", *trusting(task.policy, task.public_key),
            "--connect", self._endpoint, "--vehicle-id", VEHICLE_ID, ready="ready", quiet=True,
        )  # fmt: skip

    def drive(self, chunk: Chunk) -> dict[str, Any]:
        """Drive a chunk undisturbed by the machine; what the campaign keeps of it."""
        try:
            parts = self._undisturbed(chunk, ATTEMPTS)
        except UserError as error:
            # Nobody listens between two chunks: any process of the machine may take the port. And
            # lock-step crawls beside an edge runtime that has lost its wire: each step waits.
            if not isinstance(error, CommandTimeoutError) and "is in use" not in str(error):
                raise
            self.close()
            self.start_edge()
            parts = self._undisturbed(chunk, ATTEMPTS)
        return {"parts": [worth_keeping(part) for part in parts]}

    def close(self) -> None:
        """End the edge runtime."""
        self.edge.end()

    def _undisturbed(self, chunk: Chunk, attempts: int) -> list[dict[str, Any]]:
        """Drive a chunk, and a disturbed one again in halves: the good half is done then.

        The edge runtime lives in wall time: where it gets no processor for 2 T it rightly stops,
        and virtual time knows nothing of that.
        """
        spec, first_seed, episodes = chunk
        report: dict[str, Any] = simulate(
            self._endpoint, VEHICLE_ID, self._out, CHUNK_LIMIT_S,
            "--env", self._task.scenario, "--condition", self._task.condition,
            "--episodes", str(episodes), "--seed", str(first_seed),
            "--clock", "lockstep", "--latency", spec,
        )  # fmt: skip
        if not report["wall_clock_stalls"]:
            return [report]
        if attempts == 1:
            raise UserError(
                f"{spec}: the edge runtime gets too little processor time for a drive "
                "without a pause; use fewer --jobs (rows that are done are kept)"
            )
        if episodes == 1:
            return self._undisturbed(chunk, attempts - 1)
        halves = [Chunk(spec, *turn) for turn in turns(first_seed, episodes, (episodes + 1) // 2)]
        return [report for half in halves for report in self._undisturbed(half, attempts)]
