"""``python -m trainer experiment``: compute what is missing of a study, then write its page.

Units are computed in processes of this machine or on a Ray cluster. Each leaves a file of its own;
the tables are made of these at the end, or by the next command.
"""

import argparse
import multiprocessing
import os
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from bridge.report import ProgressBar
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError
from trainer import util
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE
from trainer.experiments import plan, report
from trainer.experiments.compute import BUSY, FAILED, FINISHED, STOPPED, Job, compute
from trainer.experiments.plan import FOREIGN, REPORT, STATUS, STUDIES, TYPICAL
from trainer.experiments.records import RECORD_FILE, Store
from trainer.human import MODEL_FILE
from trainer.person.coach import TYPICAL_FILE
from trainer.training.config import CONFIG_FILE
from trainer.training.metrics import METRICS_FILE
from trainer.util import check_device, deadline_s

PATIENCE_S = 1.0  # How long a unit may be held before it counts as another process's work
EXITS = (FINISHED, FAILED, STOPPED, BUSY)
"""How a unit ended, in the order of its process's exit statuses."""
FILES = (CHECKPOINT_FILE, BEST_FILE, METRICS_FILE, CONFIG_FILE, RECORD_FILE)
"""What a unit goes on from, and what it leaves."""
Files = dict[str, bytes]


def run(arguments: argparse.Namespace) -> int:
    """Compute, say how much is done, or report; return the exit status."""
    names, seeds = {*arguments.names}, arguments.seeds
    chosen = next((study for name, study in STUDIES.items() if name in names), plan.PAPER)
    alone = names & {STATUS, REPORT, TYPICAL, *STUDIES}
    if len(names) > 1 and alone and names != {STATUS, chosen.name}:
        raise UserError(f"{', '.join(sorted(alone))}: no other name goes with it")
    if TYPICAL in names:
        results, nowhere = Path(arguments.results or util.kept("results")), Path(os.devnull)
        stores = [Store(each, results / name, nowhere, nowhere) for name, each in STUDIES.items()]
        found = [store.load(store.study.units(seeds), seeds) for store in stores]
        report.write_typical(found, TYPICAL_FILE)
        print(f"wrote {TYPICAL_FILE}")
        return 0
    results = Path(arguments.results or util.kept(f"results/{chosen.name}"))
    runs = Path(arguments.runs or util.kept(f"runs/{chosen.name}"))
    if arguments.quick:
        chosen, results, runs = chosen.quick(), runs / "quick/results", runs / "quick"
    store = Store(chosen, results, runs, Path(arguments.humans))
    units = chosen.units(seeds, arguments.scenario, names)
    if STATUS in names:
        records = store.load(units, seeds)
        done = Counter(unit[:3] for unit in records.found)
        for line, count in Counter(unit[:3] for unit in units).items():
            print("{2:10} {1:24} {0:11}".format(*line), f"{done[line]} of {count} done")
        stale = f"{len(records.stale)} records of other settings"
        print(f"{len(records.found)} of {len(units)} units done; {stale}")
        return 0
    ends = Counter[str]() if REPORT in names else _compute_missing(arguments, store, units)
    records = store.load(chosen.units(seeds), seeds)
    if REPORT in names or {*units} & {*records.found}:
        print(f"wrote {report.write_page(store, records)}")
    return 1 if ends[FAILED] else 0


def _compute_missing(
    arguments: argparse.Namespace, store: Store, wanted: Sequence[plan.Unit]
) -> Counter[str]:
    """Compute the units that have no current record; return how many ended in which way."""
    if arguments.ray and arguments.device != "cpu":
        raise UserError("--ray computes on processors: leave out --device")
    check_device(arguments.device)
    if not wanted:
        raise UserError(f"{', '.join(arguments.names)}: nothing to compute in {arguments.scenario}")
    if arguments.ray and any(unit.scenario in FOREIGN for unit in wanted):
        ours = " or ".join(plan.SCENARIOS)
        raise UserError(f"--ray lacks {', '.join(FOREIGN)}: compute one with --scenario {ours}")
    # The clock that the processes have, too.
    stop_at_s = deadline_s(arguments.max_minutes, time.time)
    jobs = [Job(unit, store, stop_at_s, arguments.device) for unit in wanted]
    possible = [job for job in jobs if not job.unit.needs_human or job.human_model.is_file()]
    if left_out := len(wanted) - len(possible):
        say(f"{left_out} units left out: {store.humans} holds no human model of their scenario")
    done = store.load([job.unit for job in possible], arguments.seeds).found
    jobs = [job for job in possible if job.unit not in {*done}]
    if jobs and arguments.ray:
        ends = run_on_ray(jobs, arguments.ray)
    else:
        ends = run_here(jobs, arguments.jobs or util.cores())
    said = "".join(f", {count} {end}" for end, count in ends.items())
    print(f"{len(done)} of {len(wanted)} units were there already{said}")
    if ends[FINISHED] < len(jobs):
        print("the same command goes on")
    return ends


def run_here(jobs: Sequence[Job], processes: int) -> Counter[str]:
    """Compute units in so many processes at a time; return how many ended in which way.

    Each failure is one line. A process that dies takes no other unit with it, as one in an
    executor's pool would.
    """
    context = multiprocessing.get_context("spawn")
    ends: Counter[str] = Counter()
    waiting, working = deque(jobs), dict[Any, tuple[Any, Job]]()
    with ProgressBar("units", len(jobs)) as bar:
        try:
            while waiting or working:
                while waiting and len(working) < processes:
                    job = waiting.popleft()
                    if time.time() > job.stop_at_s:  # a process takes seconds to find that out
                        ends[STOPPED] += 1
                        continue
                    process = context.Process(target=_work, args=(job,), daemon=True)
                    with util.interrupts_blocked():
                        process.start()
                    working[process.sentinel] = process, job
                for sentinel in wait([*working]) if working else ():
                    process, job = working.pop(sentinel)
                    process.join()
                    died = process.exitcode not in range(len(EXITS))
                    if died:
                        say(f"failed: {job.unit}: its process died ({process.exitcode})")
                    ends[FAILED if died else EXITS[process.exitcode]] += 1
                    bar.advance({"last": str(job.unit)})
        finally:
            for process, _ in working.values():
                process.kill()
    return ends


def say(line: str) -> None:
    """Print one line on stderr, beside the progress bar."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)


def _work(job: Job) -> None:
    """Live as a process that computes a unit; the exit status tells how the unit ended."""
    os.nice(5)  # a machine on which somebody works stays usable
    threading.Thread(target=util.die_with_parent, daemon=True).start()
    end = FAILED
    try:
        end = compute_alone(job)
    except UserError as error:
        say(f"failed: {job.unit}: {error}")
    except BaseException as error:
        path = job.run_dir / "error.txt"
        write_atomic(path, traceback.format_exc().encode())
        say(f"failed: {job.unit}: {type(error).__name__}: {error} ({path})")
    sys.exit(EXITS.index(end))


def compute_alone(job: Job) -> str:
    """Compute a unit unless another process of this machine does."""
    with util.held(job.run_dir, PATIENCE_S) as free:
        if not free:
            say(f"left to another process: {job.unit}")
            return BUSY
        return FINISHED if job.store.record_left(job.unit) else compute(job)


def run_on_ray(jobs: Sequence[Job], address: str) -> Counter[str]:
    """Compute units as Ray tasks of one processor each; return how many ended in which way.

    ``address`` is the cluster's, as ``ray.init`` takes it; ``local`` starts one on this machine.

    Raises UserError: Ray is not installed, or nothing answers at the address.
    """
    try:
        import ray
    except ImportError:
        raise UserError("--ray needs Ray: python -m pip install '.[ray]'") from None
    if not ray.is_initialized():
        import bridge
        import edge_runtime
        import trainer

        # Nodes need the libraries; our own code is sent to them.
        modules = {"py_modules": [edge_runtime, bridge, trainer]}
        try:
            ray.init(address=address, runtime_env=modules, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UserError(f"--ray {address}: no cluster answers: {error}") from error
    remote = ray.remote(num_cpus=1, max_retries=3)(compute_parcel)  # for nodes that die
    ends: Counter[str] = Counter()
    with ExitStack() as locks:
        waiting = {}
        for job in jobs:
            if locks.enter_context(util.held(job.run_dir, PATIENCE_S)):
                waiting[remote.remote(*pack(job))] = job
            else:
                ends[BUSY] += 1
        while waiting:
            (ready, *_), _ = ray.wait(list(waiting))
            job, end = waiting.pop(ready), FAILED
            try:
                end = unpack(job, *ray.get(ready))
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                say(f"failed: {job.unit}: {type(cause).__name__}: {cause}")
            ends[end] += 1
            say(f"{job.unit}: {end}, {ends.total()} of {len(jobs)}")
    return ends


def pack(job: Job) -> tuple[Job, Files, Files]:
    """Return a job with what a node needs for it: the human model, and what it goes on from."""
    return job, _read(job.human_model.parent, [MODEL_FILE]), _read(job.run_dir, FILES)


def compute_parcel(job: Job, human: Files, working: Files) -> tuple[str, Files]:
    """Compute a unit on a node; return how it ended, and its working files."""
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        job = replace(job, store=replace(job.store, runs=root, humans=root / "humans"))
        _write(job.human_model.parent, human)
        _write(job.run_dir, working)
        return compute(job), _read(job.run_dir, FILES)


def unpack(job: Job, end: str, working: Files) -> str:
    """Keep what a node made; return how the unit ended."""
    _write(job.run_dir, working)
    if end == FINISHED:
        (job.run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
    return end


def _read(directory: Path, names: Iterable[str]) -> Files:
    """Return those of the files that are there."""
    paths = [directory / name for name in names]
    return {path.name: path.read_bytes() for path in paths if path.is_file()}


def _write(directory: Path, files: Files) -> None:
    make_directory(directory)
    for name, data in files.items():
        write_atomic(directory / name, data)
