"""``python -m hil_tests campaign``: every fault, every network of the axes, one report.

The unit of work is a chunk: some episodes of one network through a real edge runtime, kept on
disk. Each worker has an edge runtime process and an endpoint of its own.
"""

from __future__ import annotations

import argparse
import queue
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bridge.network import parse_spec
from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, sigterm_as_interrupt
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError, read_json
from hil_tests.faults.run import choose_rows, run_faults
from hil_tests.processes import BackgroundCommand, CommandTimeoutError, in_threads, trusting
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
    add_sweep_arguments,
    budget,
    episodes_of,
    make_row,
    policy_of,
    several,
    simulate,
    this_command,
)
from trainer.evaluate import cores
from trainer.util import ProgressBar

PARTS = ("latency", "faults")
NO_ROWS = "none"
"""``--rows none``: nothing but what ``--check-realtime`` asks for."""
VEHICLE_ID = "campaign01"
CHUNK_EPISODES = {"lockstep": 50, "realtime": 5}
"""In real time an episode takes as long as it takes: small chunks share the work better."""
CHUNK_LIMIT_S = 900.0
ATTEMPTS = 6
FORMAT = 1
"""Raise it where the same specification begins to mean another drive: kept chunks become void."""
SHOWN_WRONG = 5
EXAMPLE = examples(
    "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
    "python -m hil_tests campaign --only latency --rows none --check-realtime 50ms,loss=1% \\\n"
    "    --out runs/realtime.json",
    "python -m hil_tests campaign --only faults --rows 'hunter_*' --tries 100 --out runs/f.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_sweep_arguments(parser, 100, "episodes of each latency row, the same seeds", 0.98)
    parser.add_argument("--only", choices=PARTS, help="one part (default: both)")
    parser.add_argument(
        "--rows",
        metavar="NAME,...",
        help=f"only these latency axes ({', '.join(axis.name for axis in NETWORK_AXES)}) and "
        f"faults, by name or pattern (hunter_*); {NO_ROWS}: only what --check-realtime asks for",
    )
    parser.add_argument(
        "--clock",
        choices=("lockstep", "realtime"),
        default="lockstep",
        help="of the latency rows: virtual time, or the wall clock (slow)",
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="vehicles at once, each with an edge runtime and an endpoint of its own; "
        "0: one a core; changes no result in virtual time",
    )
    parser.add_argument(
        "--check-realtime",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="drive these networks in real time, too, and say whether success agrees",
    )
    parser.add_argument(
        "--realtime-runs", type=several, default=40, help="episodes of each of those"
    )
    parser.add_argument(
        "--realtime-jobs", type=positive, default=4, metavar="N", help="vehicles at once in those"
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
    for spec in arguments.check_realtime:
        parse_spec(spec)
    axes, faults = _choose(arguments)
    others = dict(_other(text) for text in arguments.against)
    report: dict[str, Any] = {"command": this_command()}
    name = Path(arguments.policy or f"{arguments.scenario}.onnx").name
    text = [f"# Campaign: {name}, {arguments.scenario}", "", f"`{this_command()}`", ""]
    if axes or arguments.check_realtime:
        with sigterm_as_interrupt():  # Whoever ends a campaign ends its processes.
            latency = _run_latency(arguments, axes, out.with_name(f"{out.stem}_rows"))
        figures = write_figures(out, latency, others) if axes else {}
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
    if arguments.rows == NO_ROWS:
        return [], None
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
    with ExitStack() as stack:
        bar: ProgressBar | None = None

        def on_progress(row: str, done: int, total: int) -> None:
            nonlocal bar
            bar = bar or stack.enter_context(ProgressBar("faults", total))
            bar.advance({"row": row}, done - bar.done)

        return run_faults(
            arguments.tries, names or None, policy, on_progress, arguments.jobs,
            arguments.public_key,
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
    latency, faults = report.get("latency"), report.get("faults")
    if latency and latency["budget"]:
        print(latency["budget"]["sentence"])
    if latency and latency["realtime_check"]:
        verdict = "agrees" if latency["realtime_check"]["agree"] else "does NOT agree"
        print(f"Success in real time {verdict} with virtual time within the intervals.")
    if faults:
        for row in faults["rows"]:
            for kind in ("wrong", "unsafe", "crashes"):
                for what in row[kind][:SHOWN_WRONG]:
                    print(f"{row['name']}: {kind}: {what}")
        print("Every fault was met." if faults["passed"] else "Not every fault was met.")
    print(f"{out} and {out.with_suffix('.md')}")


@dataclass(frozen=True)
class Task:
    """What every chunk of a campaign has in common."""

    policy: Path
    policy_id: str
    scenario: str
    condition: str
    clock: str
    public_key: str | None = None


@dataclass(frozen=True)
class Chunk:
    """Episodes with the seeds ``first_seed``, ``first_seed + 1``, ...: the same for every row."""

    spec: str
    first_seed: int
    episodes: int


def _run_latency(arguments: argparse.Namespace, axes: Sequence[Axis], keep: Path) -> dict[str, Any]:
    """Sweep the axes and check against real time; the part ``latency`` of the report."""
    policy, policy_id = policy_of(arguments)
    task = Task(
        policy, policy_id, arguments.scenario, arguments.condition, arguments.clock,
        arguments.public_key,
    )  # fmt: skip
    specs = list(dict.fromkeys(spec for axis in axes for spec in axis.specs))
    rows = drive_rows(task, specs, arguments.seed, arguments.runs, arguments.jobs, keep)
    driven_s, wall_s = (sum(row[name] for row in rows.values()) for name in ("driven_s", "wall_s"))
    return {
        "scenario": task.scenario,
        "condition": task.condition,
        "policy": str(policy),
        "policy_id": policy_id,
        "clock": task.clock,
        "seed": arguments.seed,
        "runs": arguments.runs,
        "axes": [axis.as_dict() for axis in axes],
        "rows": rows,
        "budget": budget(axes, rows, arguments.target, policy.stem) if axes else None,
        "faster_than_real_time": driven_s / wall_s if wall_s else None,
        "realtime_check": _check_realtime(task, arguments, keep),
    }


def _check_realtime(task: Task, arguments: argparse.Namespace, keep: Path) -> dict[str, Any] | None:
    """Drive some rows in real time, too, and compare."""
    specs = [str(parse_spec(spec)) for spec in arguments.check_realtime]
    if not specs:
        return None
    runs = arguments.realtime_runs
    virtual, real = (
        drive_rows(replace(task, clock=clock), specs, arguments.seed, runs, jobs, keep)
        for clock, jobs in (("lockstep", arguments.jobs), ("realtime", arguments.realtime_jobs))
    )
    compared = [
        {
            "spec": spec,
            "virtual": virtual[spec]["success"],
            "real": real[spec]["success"],
            "virtual_safe_stops_per_episode": virtual[spec]["safe_stops_per_episode"],
            "real_safe_stops_per_episode": real[spec]["safe_stops_per_episode"],
            "agree": agree(virtual[spec]["success"], real[spec]["success"]),
        }
        for spec in specs
    ]
    return {"runs": runs, "rows": compared, "agree": all(row["agree"] for row in compared)}


def agree(first: dict[str, float], second: dict[str, float]) -> bool:
    """Whether two intervals overlap."""
    return first["low"] <= second["high"] and second["low"] <= first["high"]


def drive_rows(
    task: Task, specs: Sequence[str], seed: int, runs: int, jobs: int, keep: Path
) -> dict[str, dict[str, Any]]:
    """The rows of the specifications; what is kept in ``keep`` is not driven again."""
    deciding = {"format": FORMAT, "policy": task.policy_id, "clock": task.clock}
    store = KeptResults(keep, task.scenario, task.condition, deciding)
    size = CHUNK_EPISODES[task.clock]
    chunks = {spec: chunks_of(spec, seed, runs, size) for spec in specs}
    asked = [chunk for spec in specs for chunk in chunks[spec]]
    kept = {chunk: found for chunk in asked if (found := store.load(asdict(chunk))) is not None}
    missing = [chunk for chunk in asked if chunk not in kept]
    with ProgressBar(f"latency, {task.clock}", len(asked), len(kept)) as bar:

        def on_chunk(chunk: Chunk, found: dict[str, Any]) -> None:
            kept[chunk] = found
            store.save(asdict(chunk), found)
            success = found["success_rate"]
            bar.advance({"success": f"{success:.2f}", "of": chunk.spec})

        if missing:
            drive_chunks(task, missing, jobs, on_chunk)
    return {spec: make_row(spec, [kept[chunk] for chunk in chunks[spec]]) for spec in specs}


def chunks_of(spec: str, seed: int, runs: int, size: int) -> list[Chunk]:
    """The chunks of one row."""
    return [Chunk(spec, seed + done, min(size, runs - done)) for done in range(0, runs, size)]


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
        in_threads(work, chunks, jobs, on_chunk)


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
        began_s = time.monotonic()
        try:
            reports = self._undisturbed(chunk, ATTEMPTS)
        except UserError as error:
            # Nobody listens between two chunks: any process of the machine may take the port. And
            # lock-step crawls beside an edge runtime that has lost its wire: each step waits.
            if not isinstance(error, CommandTimeoutError) and "is in use" not in str(error):
                raise
            self.close()
            self.start_edge()
            reports = self._undisturbed(chunk, ATTEMPTS)
        return worth_keeping(chunk, reports, time.monotonic() - began_s)

    def close(self) -> None:
        """End the edge runtime."""
        self.edge.end()

    def _undisturbed(self, chunk: Chunk, attempts: int) -> list[dict[str, Any]]:
        """Drive a chunk, and a disturbed one again in halves: the good half is done then.

        The edge runtime lives in wall time: where it gets no processor for 2 T it rightly stops,
        and virtual time knows nothing of that.
        """
        report = self._simulate(chunk)
        if self._task.clock == "realtime" or not report["wall_clock_stalls"]:
            return [report]
        if attempts == 1:
            raise UserError(
                f"{chunk.spec}: the edge runtime gets too little processor time for a drive "
                "without a pause; use fewer --jobs (rows that are done are kept)"
            )
        if chunk.episodes == 1:
            return self._undisturbed(chunk, attempts - 1)
        half = (chunk.episodes + 1) // 2
        halves = chunks_of(chunk.spec, chunk.first_seed, chunk.episodes, half)
        return [report for each in halves for report in self._undisturbed(each, attempts)]

    def _simulate(self, chunk: Chunk) -> dict[str, Any]:
        task = self._task
        return simulate(
            self._endpoint, VEHICLE_ID, self._out, CHUNK_LIMIT_S,
            "--env", task.scenario, "--condition", task.condition,
            "--episodes", str(chunk.episodes), "--seed", str(chunk.first_seed),
            "--clock", task.clock, "--latency", chunk.spec,
        )  # fmt: skip


def worth_keeping(chunk: Chunk, reports: Sequence[dict[str, Any]], wall_s: float) -> dict[str, Any]:
    """What the campaign needs of a chunk, joined where it was driven in parts.

    Latencies: the mean of the parts' p50, and the largest p99.
    """
    heard = [part["latency_ms"] for part in reports if part["latency_ms"]["p50"] is not None]
    episodes = [episode for part in reports for episode in episodes_of(part)]
    counts = ("deadline_misses", "tick_overruns", "safe_stops")
    return {
        "spec": chunk.spec,
        "command": reports[0]["command"],
        "wall_s": round(wall_s, 3),
        "success_rate": statistics.fmean(e["outcome"] == "goal" for e in episodes),
        "latency_ms": {
            "p50": statistics.fmean(part["p50"] for part in heard) if heard else None,
            "p99": max(part["p99"] for part in heard) if heard else None,
        },
        **{name: sum(part[name] for part in reports) for name in counts},
        "rejected": dict(sum((Counter(part["rejected"]) for part in reports), Counter())),
        "episodes": episodes,
    }
